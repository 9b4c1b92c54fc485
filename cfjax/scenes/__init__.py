"""Problems with known answers, one to a module."""

from . import allen_cahn as allen_cahn
from . import annealing as annealing
from . import covariance as covariance
from . import gray_scott as gray_scott
from . import harmonic_maps as harmonic_maps
from . import heat as heat
from . import heavy_top as heavy_top
from . import hmc as hmc
from . import imu as imu
from . import kuramoto_sivashinsky as kuramoto_sivashinsky
from . import landau_zener as landau_zener
from . import macrospin as macrospin
from . import porous_medium as porous_medium
from . import rigid_body as rigid_body
from . import rotational_diffusion as rotational_diffusion
from . import spacecraft as spacecraft
from . import spin_waves as spin_waves
from . import spins as spins
from . import stiefel as stiefel
from . import tennis_racket as tennis_racket
from . import toda as toda
from . import transmon as transmon
from . import vortices as vortices
from . import wilson_flow as wilson_flow
from . import zeitlin as zeitlin
