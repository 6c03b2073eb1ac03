"""Clearpath Husky outdoors: wheel odometry, a small inertial unit with its y axis up, satellite fixes of metres.

There is no truth. Header stamps are kept; recording stamps become log times when it is written.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.recordings import Recording, fixes, imu, read_npz, rig_of, stamps
from tbmfg.timeseries import Series


def load(source: str | Path) -> Recording:
    """The drive; the robot's own integration is in its odometry's pose."""
    arrays = read_npz(source)
    rig = rig_of("husky")
    t0_ns = int(stamps(np.asarray(arrays["t0_unix"])))
    odometer_ns = stamps(arrays["odom_t"], t0_ns)
    nothing = np.zeros(len(odometer_ns))
    odometry = {
        "position": np.column_stack([arrays["odom_xy"], nothing]),
        "quat_xyzw": np.column_stack([nothing, nothing, arrays["odom_qzw"]]),
        "linear": np.column_stack([arrays["odom_vx"], arrays["odom_vy"], nothing]),
        "angular": np.column_stack([nothing, nothing, arrays["odom_wz"]]),
    }
    series = (
        imu(rig.imu.topic, stamps(arrays["imu_t"], t0_ns), arrays["imu_gyr"], arrays["imu_acc"]),
        Series(rig.sensors["odometer"].topic, "nav_msgs/msg/Odometry", odometer_ns, odometry, "odom", "base_link"),
        fixes(
            rig.sensors["gnss"].topic,
            stamps(arrays["gps_t"], t0_ns),
            arrays["gps_llh"],
            np.sqrt(arrays["gps_var"]),
            arrays["gps_status"],
        ),
    )
    logged = {"imu": "imu_trec", "odometer": "odom_trec", "gnss": "gps_trec"}
    log_ns = {rig.sensors[name].topic: stamps(arrays[column], t0_ns) for name, column in logged.items()}
    return Recording(series, rig, log_ns)
