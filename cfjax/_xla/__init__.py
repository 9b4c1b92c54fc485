"""All that reads and rewrites programs, so that XLA makes fast code of them.

- `scalarised`, `repeat`: a step, and many equal ones, on single numbers.
- `over_stages`, `chosen`: a loop over the stages of a method, and a choice within it, which are
  part of what is scalarised; `where_scalarised`, `computed_again`: what is computed otherwise
  there.
- `materialised_together`, `computed_once`: values that several results need, computed once.
- `pack`, `unpack`: `jnp.stack` and `jnp.unstack` in a form that XLA fuses.
- `smooth`: a mark of functions that compare numbers and yet are smooth up to rounding.
- `materialised`, `call`: arrays and functions that XLA computes on their own.
- `limits`: the numbers that decide.
- `rewriting`: the switch that turns it all off; `is_rewritten`: what there is around.

Nothing outside may import from the files within. `README.md` here says what each trick buys.
"""

from . import limits as limits
from .loop import repeat as repeat
from .materialise import call as call
from .materialise import computed_once as computed_once
from .materialise import materialised as materialised
from .materialise import materialised_together as materialised_together
from .over_stages import chosen as chosen
from .over_stages import computed_again as computed_again
from .over_stages import over_stages as over_stages
from .over_stages import where_scalarised as where_scalarised
from .pack import pack as pack
from .pack import unpack as unpack
from .scope import is_rewritten as is_rewritten
from .scope import rewriting as rewriting
from .smooth import smooth as smooth
from .step import scalarised as scalarised
