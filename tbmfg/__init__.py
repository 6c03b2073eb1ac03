"""tbmfg: where is the machine, and how sure are we? Smoothing of recorded underground logs.

Conventions, stated once and held everywhere:

Frames
    ``n``  navigation frame of the position sensor, z up. The rig's ``x_axis_azimuth_deg`` says how
           its x axis lies, clockwise from north (90: x east, y north).
    ``b``  body frame: origin at the IMU, axes forward-left-up (REP-103).
    ``i``  IMU axes; ``T_bi`` turns them into ``b``.
    ``T_ab`` takes coordinates in b to coordinates in a; so do ``R_ab`` and ``p_ab``.
    A vector's suffix is the frame it is resolved in: ``velocity_n``, ``omega_b``, ``arm_b``.

Units
    SI and radians inside. Anything else carries a suffix (``_deg``, ``_mm``) and lives only in
    YAML, on the command line and in reports.

Time
    int64 nanoseconds of the header stamp; only differences become float seconds.
    Clock offset = stamp minus true (IMU) time: positive when stamps are late.

Errors
    Right (body) perturbation ``R_nb Exp(d)``; order rotation, position, velocity, accelerometer
    bias, gyro bias. ``cov`` has rotation in b, position and velocity in n. Odometer:
    indicated = (1 + scale) x true. Lever arms go from the IMU to the point, resolved in b.
    A quaternion's name holds its order (``quat_xyzw``). ``sigma`` and ``sd`` are standard deviations.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tbmfg.api import Comparison, compare, run
    from tbmfg.errors import TbmfgError
    from tbmfg.mcap import read_log
    from tbmfg.rig import Rig, load_rig
    from tbmfg.state import Result, Trajectory

__version__ = "0.1.0"
__all__ = ["Comparison", "Result", "Rig", "TbmfgError", "Trajectory", "compare", "load_rig", "read_log", "run"]

_HOMES = {
    "Comparison": "tbmfg.api",
    "compare": "tbmfg.api",
    "run": "tbmfg.api",
    "TbmfgError": "tbmfg.errors",
    "read_log": "tbmfg.mcap",
    "Rig": "tbmfg.rig",
    "load_rig": "tbmfg.rig",
    "Result": "tbmfg.state",
    "Trajectory": "tbmfg.state",
}


def __getattr__(name: str) -> Any:
    """Names of the library, loaded when asked for: ``import tbmfg`` and ``tbmfg --help`` answer at once."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
