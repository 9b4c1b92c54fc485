"""All that reads and rewrites programs, so that XLA makes fast code of them.

- `by_components`, `repeat`: a step, and many equal ones, on single numbers.
- `table`: the stages of a long step, each taken apart; `are_long`: whether they make one.
- `cut`, `once_together`, `once_in_rows`: values that several results need, computed once.
- `pack`, `unpack`: `jnp.stack` and `jnp.unstack` in a form that XLA fuses.
- `smooth`: a mark of functions that compare numbers and yet are smooth up to rounding.
- `held`, `call`: arrays through memory, and functions that XLA compiles on their own.
- `rewriting`: the switch that turns it all off; `is_rewritten`: what there is around.

Nothing outside may import from the files within. `README.md` here says what each trick buys.
"""

from .call import call as call
from .held import cut as cut
from .held import held as held
from .held import once_in_rows as once_in_rows
from .held import once_together as once_together
from .loop import repeat as repeat
from .pack import pack as pack
from .pack import unpack as unpack
from .program import are_long as are_long
from .program import by_components as by_components
from .scope import is_rewritten as is_rewritten
from .scope import rewriting as rewriting
from .smooth import smooth as smooth
from .table import table as table
