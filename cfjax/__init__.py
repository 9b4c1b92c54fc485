"""Commutator-free Lie group integrators for JAX."""

from . import scenes as scenes
from ._error_control import ErrorNorm as ErrorNorm
from ._error_control import starting_step as starting_step
from ._fields.low_rank import BorderedSkew as BorderedSkew
from ._fields.low_rank import LowRankSkew as LowRankSkew
from ._fields.matrix import LeftMatrix as LeftMatrix
from ._fields.matrix import RightMatrix as RightMatrix
from ._fields.rotation import Rotation as Rotation
from ._frozen_field import AbstractAlgebraElement as AbstractAlgebraElement
from ._frozen_field import AbstractFrozenField as AbstractFrozenField
from ._frozen_field import bracket as bracket
from ._frozen_field import combine as combine
from ._frozen_field import flow as flow
from ._frozen_field import tangent as tangent
from ._integrate import integrate as integrate
from ._order_conditions import error_constant as error_constant
from ._order_conditions import order as order
from ._solvers.commutator_free import CF2 as CF2
from ._solvers.commutator_free import CF3 as CF3
from ._solvers.commutator_free import CF4 as CF4
from ._solvers.commutator_free import CF43 as CF43
from ._solvers.commutator_free import CF54 as CF54
from ._solvers.commutator_free import CG3 as CG3
from ._solvers.commutator_free import CG4 as CG4
from ._solvers.commutator_free import CG5 as CG5
from ._solvers.commutator_free import CommutatorFree as CommutatorFree
from ._solvers.commutator_free import LieEuler as LieEuler
from ._solvers.munthe_kaas import RKMK as RKMK
from ._solvers.munthe_kaas import RKMK3 as RKMK3
from ._solvers.munthe_kaas import RKMK4 as RKMK4
from ._tableau import Tableau as Tableau
from ._tableau import third_order_a as third_order_a
from ._tableau import third_order_b as third_order_b
from ._term import LieTerm as LieTerm

__version__ = "0.1.0"
