"""Commutator-free Lie group integrators for JAX."""

import importlib
from typing import TYPE_CHECKING, Any

from . import _signals

if _signals.is_command():
    # Before the imports below, which take seconds.
    _signals.end_the_command()

from ._control_term import LieControlTerm as LieControlTerm
from ._field import AbstractAlgebraElement as AbstractAlgebraElement
from ._field import AbstractFrozenField as AbstractFrozenField
from ._field import bracket as bracket
from ._field import combine as combine
from ._field import flow as flow
from ._field import tangent as tangent
from ._fields.coordinates import Nearest as Nearest
from ._fields.elementwise import elementwise as elementwise
from ._fields.matrix import LeftMatrix as LeftMatrix
from ._fields.matrix import RightMatrix as RightMatrix
from ._fields.quaternion import QuaternionRotation as QuaternionRotation
from ._fields.rotation import Rotation as Rotation
from ._fields.semilinear import AbstractSemilinearField as AbstractSemilinearField
from ._integrate import integrate as integrate
from ._methods.order_conditions import error_constant as error_constant
from ._methods.order_conditions import order as order
from ._methods.tableau import Tableau as Tableau
from ._methods.tableau import third_order_a as third_order_a
from ._methods.tableau import third_order_b as third_order_b
from ._numerics.attitude import quaternion_from_matrix as quaternion_from_matrix
from ._numerics.attitude import quaternion_rotate as quaternion_rotate
from ._numerics.attitude import quaternion_to_matrix as quaternion_to_matrix
from ._numerics.expm import expm as expm
from ._numerics.stumpff import stumpff as stumpff
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
from ._solvers.error_control import ErrorNorm as ErrorNorm
from ._solvers.error_control import starting_step as starting_step
from ._solvers.solver import AbstractSolver as AbstractSolver
from ._term import LieTerm as LieTerm
from ._xla import rewriting as rewriting

if TYPE_CHECKING:
    from . import scenes as scenes
    from ._batch.batch import BatchResult as BatchResult
    from ._batch.batch import map_batch as map_batch
    from ._fields.affine import Affine as Affine
    from ._fields.conjugation import Congruence as Congruence
    from ._fields.conjugation import Conjugation as Conjugation
    from ._fields.extended_motion import ExtendedMotion as ExtendedMotion
    from ._fields.inertial_motion import InertialMotion as InertialMotion
    from ._fields.lindblad import Lindblad as Lindblad
    from ._fields.linear_affine import LinearAffine as LinearAffine
    from ._fields.low_rank import BorderedSkew as BorderedSkew
    from ._fields.low_rank import LowRankSkew as LowRankSkew
    from ._fields.operator_sum import OperatorSum as OperatorSum
    from ._fields.rigid_motion import PlanarMotion as PlanarMotion
    from ._fields.rigid_motion import RigidMotion as RigidMotion
    from ._fields.scaling import Scaling as Scaling
    from ._fields.sphere import SphereRotation as SphereRotation
    from ._measure.work_precision import WorkPrecision as WorkPrecision
    from ._measure.work_precision import work_precision as work_precision
    from ._methods.exponential import ExponentialTableau as ExponentialTableau
    from ._methods.stability import stability_function as stability_function
    from ._methods.stiff_order import stiff_order as stiff_order
    from ._numerics.diagonalised import diagonalised as diagonalised
    from ._numerics.phi import phi as phi
    from ._numerics.transforms import AbstractTransform as AbstractTransform
    from ._numerics.transforms import CosineTransform as CosineTransform
    from ._numerics.transforms import FourierTransform as FourierTransform
    from ._numerics.transforms import RealFourierTransform as RealFourierTransform
    from ._numerics.transforms import SineTransform as SineTransform
    from ._numerics.transforms import TensorTransform as TensorTransform
    from ._solvers.composition import Composition as Composition
    from ._solvers.exponential import ETD43 as ETD43
    from ._solvers.exponential import ETD54 as ETD54
    from ._solvers.exponential import ETDRK4 as ETDRK4
    from ._solvers.exponential import ExponentialRungeKutta as ExponentialRungeKutta
    from ._solvers.implicit_midpoint import ImplicitMidpoint as ImplicitMidpoint
    from ._solvers.kraus import Kraus4 as Kraus4
    from ._solvers.low_storage import BWRRK33 as BWRRK33
    from ._solvers.low_storage import BWRRK53 as BWRRK53
    from ._solvers.low_storage import CFEES25 as CFEES25
    from ._solvers.low_storage import CFEES27 as CFEES27
    from ._solvers.low_storage import CK34 as CK34
    from ._solvers.low_storage import CK54 as CK54
    from ._solvers.low_storage import YRK135 as YRK135
    from ._solvers.low_storage import Luscher3 as Luscher3
    from ._solvers.low_storage import Williamson3 as Williamson3
    from ._solvers.magnus import Magnus2 as Magnus2
    from ._solvers.magnus import Magnus4 as Magnus4
    from ._solvers.magnus import Magnus4Lobatto as Magnus4Lobatto
    from ._solvers.magnus import Magnus6 as Magnus6
    from ._solvers.magnus import Magnus8 as Magnus8
    from ._solvers.magnus import Magnus10 as Magnus10
    from ._solvers.munthe_kaas import RKMK as RKMK
    from ._solvers.munthe_kaas import RKMK3 as RKMK3
    from ._solvers.munthe_kaas import RKMK4 as RKMK4
    from ._solvers.munthe_kaas import RKMK5 as RKMK5
    from ._solvers.munthe_kaas import RKMK8 as RKMK8
    from ._solvers.munthe_kaas import CayleyRK4 as CayleyRK4
    from ._solvers.pieces import ShiftedNoise as ShiftedNoise
    from ._solvers.pieces import WeakOrder2 as WeakOrder2
    from ._solvers.projected import Projected as Projected
    from ._solvers.richardson import Richardson as Richardson
    from ._solvers.spectral_radius import spectral_radius as spectral_radius
    from ._solvers.splitting import BlanesMoan4 as BlanesMoan4
    from ._solvers.splitting import BlanesMoan6 as BlanesMoan6
    from ._solvers.splitting import Splitting as Splitting
    from ._solvers.splitting import Strang as Strang
    from ._solvers.stabilised import RKG2 as RKG2
    from ._solvers.stabilised import RKL2 as RKL2
    from ._solvers.stabilised import RKL3 as RKL3
    from ._testing import check_field as check_field
    from ._testing import check_terms as check_terms
    from ._variation.basis import algebra_basis as algebra_basis
    from ._variation.term import VariationTerm as VariationTerm
    from ._variation.variation import Variation as Variation

__version__ = "0.2.0"

# What not every solve uses is imported where it is first asked for: to make its classes and
# coefficients takes longer than all the rest of this import.
_NAMES_LATER = {
    "_fields.affine": ("Affine",),
    "_testing": ("check_field", "check_terms"),
    "_fields.conjugation": ("Congruence", "Conjugation"),
    "_fields.extended_motion": ("ExtendedMotion",),
    "_fields.inertial_motion": ("InertialMotion",),
    "_fields.lindblad": ("Lindblad",),
    "_fields.linear_affine": ("LinearAffine",),
    "_fields.low_rank": ("BorderedSkew", "LowRankSkew"),
    "_fields.operator_sum": ("OperatorSum",),
    "_fields.rigid_motion": ("PlanarMotion", "RigidMotion"),
    "_fields.scaling": ("Scaling",),
    "_fields.sphere": ("SphereRotation",),
    "_batch.batch": ("BatchResult", "map_batch"),
    "_measure.work_precision": ("WorkPrecision", "work_precision"),
    "_methods.exponential": ("ExponentialTableau",),
    "_methods.stability": ("stability_function",),
    "_methods.stiff_order": ("stiff_order",),
    "_numerics.phi": ("phi",),
    "_numerics.diagonalised": ("diagonalised",),
    "_numerics.transforms": (
        "AbstractTransform",
        "CosineTransform",
        "FourierTransform",
        "RealFourierTransform",
        "SineTransform",
        "TensorTransform",
    ),
    "_solvers.composition": ("Composition",),
    "_solvers.exponential": ("ETD43", "ETD54", "ETDRK4", "ExponentialRungeKutta"),
    "_solvers.implicit_midpoint": ("ImplicitMidpoint",),
    "_solvers.kraus": ("Kraus4",),
    "_solvers.low_storage": (
        "BWRRK33",
        "BWRRK53",
        "CFEES25",
        "CFEES27",
        "CK34",
        "CK54",
        "Luscher3",
        "Williamson3",
        "YRK135",
    ),
    "_solvers.magnus": ("Magnus10", "Magnus2", "Magnus4", "Magnus4Lobatto", "Magnus6", "Magnus8"),
    "_solvers.munthe_kaas": ("RKMK", "RKMK3", "RKMK4", "RKMK5", "RKMK8", "CayleyRK4"),
    "_solvers.pieces": ("ShiftedNoise", "WeakOrder2"),
    "_solvers.projected": ("Projected",),
    "_solvers.richardson": ("Richardson",),
    "_solvers.spectral_radius": ("spectral_radius",),
    "_solvers.stabilised": ("RKG2", "RKL2", "RKL3"),
    "_solvers.splitting": ("BlanesMoan4", "BlanesMoan6", "Splitting", "Strang"),
    "_variation.basis": ("algebra_basis",),
    "_variation.term": ("VariationTerm",),
    "_variation.variation": ("Variation",),
}
_LATER = {name: f".{module}" for module, names in _NAMES_LATER.items() for name in names}
_LATER["scenes"] = ".scenes"


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_LATER[name], __name__)
    value = module if name == "scenes" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals().keys() | _LATER.keys())
