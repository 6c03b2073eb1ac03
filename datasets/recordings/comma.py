"""Car on a motorway: wheel speeds, a device's inertia, magnetometer and satellite fixes, pose truth (comma2k19).

b is the device, forward-left-up; the truth is that of its camera, whose axes are the same to a few degrees. Stamps are
seconds since the device booted. The magnetometer is in the log and not in the rig: its heading is 46 degrees off.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from datasets.recordings import Arrays, Recording, fixes, imu, magnetic, read_npz, rig_of, stamps
from tbmfg import earth
from tbmfg.errors import TbmfgError
from tbmfg.timeseries import Floats, Series

SD_ENU = (3.0, 3.0, 6.0)  # m: the fixes do not say; a single-frequency receiver in the open
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])


GYRO = {"raw": "imu_gyro_uncalibrated", "device": "imu_gyro"}  # ``device``: less its own running estimate of the bias


def load(source: str | Path, *, gyro: str = "raw") -> Recording:
    """The minute; n touches the Earth at the first fix. ``gyro`` raw, or as the device's own calibration leaves it."""
    if gyro not in GYRO:
        raise TbmfgError(f"comma: gyro={gyro}; there are {', '.join(GYRO)}")
    arrays = read_npz(source)
    rig = rig_of("comma")
    speed = arrays["can_wheel_speed"].mean(axis=1)
    speeds = {"linear": np.column_stack([speed, np.zeros((len(speed), 2))]), "angular": np.zeros((len(speed), 3))}
    speed_ns = stamps(arrays["can_wheel_speed_t"])
    latitude, longitude, _, _, height, _ = arrays["gnss_live_gnss_ublox"].T
    fix_ns = stamps(arrays["gnss_live_gnss_ublox_t"])
    llh_deg = np.column_stack([latitude, longitude, height])
    origin_llh = llh_deg[0] * [np.pi / 180, np.pi / 180, 1.0]
    rates, acc = arrays[GYRO[gyro]], arrays["imu_accelerometer"]
    topics = {name: sensor.topic for name, sensor in rig.sensors.items()}
    series = (
        imu(topics["imu"], stamps(arrays["imu_accelerometer_t"]), rates, acc),
        Series(topics["odometer"], "geometry_msgs/msg/TwistStamped", speed_ns, speeds, "base_link"),
        fixes(topics["gnss"], fix_ns, llh_deg, np.tile(SD_ENU, (len(fix_ns), 1))),
        magnetic("/magnetometer", stamps(arrays["imu_magnetometer_t"]), arrays["imu_magnetometer"]),
        _truth(rig.truth.topic, arrays, origin_llh, rig.origin.x_axis_azimuth),
    )
    return Recording(series, rig)


def _truth(topic: str, arrays: Arrays, origin_llh: Floats, x_axis_azimuth: float) -> Series:
    """The camera's poses; given Earth-fixed, attitude as the rotation from forward-right-down axes."""
    R_ne = earth.R_ne(origin_llh[0], origin_llh[1], x_axis_azimuth)
    wxyz = arrays["pose_frame_orientations"]
    R_nb = R_ne @ Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() @ FRD_FROM_FLU
    velocity_n = arrays["pose_frame_velocities"] @ R_ne.T
    columns = {
        "position": (arrays["pose_frame_positions"] - earth.ecef_from_llh(origin_llh)) @ R_ne.T,
        "quat_xyzw": Rotation.from_matrix(R_nb).as_quat(),
        "linear": np.einsum("nji,nj->ni", R_nb, velocity_n),
        "angular": np.zeros((len(wxyz), 3)),
    }
    return Series(topic, "nav_msgs/msg/Odometry", stamps(arrays["pose_frame_times"]), columns, "n", "b")
