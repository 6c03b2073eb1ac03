"""The rig: one machine's sensors, mountings, noise and priors, read from YAML.

The fields are what a person writes, with the unit in the name (``sigma_mm``). Beside each stands a
property without the unit (``sigma``) that gives the same quantity in SI and radians, triples as
(3,) arrays. Conversion happens here and nowhere else.

A problem with a rig is a :class:`~tbmfg.errors.RigError` of one line per fault: file and line, key, reason.
"""

from tbmfg.rig.files import dump_rig, load_rig, override, parse_rig, shipped, switches
from tbmfg.rig.machine import (
    Deviation,
    Initial,
    Keyframes,
    Motion,
    Origin,
    Rig,
    SurveyPoint,
    TruthTopic,
    ZeroVelocity,
)
from tbmfg.rig.sensors import (
    KINDS,
    OWN_KINDS,
    Barometer,
    Enhancement,
    Gnss,
    Imu,
    Laser,
    Lidar,
    Magnetometer,
    Mounting,
    Odometer,
    PositionSensor,
    Prism,
    Sensor,
    kind_of,
)

__all__ = [
    "KINDS",
    "OWN_KINDS",
    "Barometer",
    "Deviation",
    "Enhancement",
    "Gnss",
    "Imu",
    "Initial",
    "Keyframes",
    "Laser",
    "Lidar",
    "Magnetometer",
    "Motion",
    "Mounting",
    "Odometer",
    "Origin",
    "PositionSensor",
    "Prism",
    "Rig",
    "Sensor",
    "SurveyPoint",
    "TruthTopic",
    "ZeroVelocity",
    "dump_rig",
    "kind_of",
    "load_rig",
    "override",
    "parse_rig",
    "shipped",
    "switches",
]
