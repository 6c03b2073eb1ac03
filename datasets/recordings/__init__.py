"""Public recordings as MCAP logs: ``python -m datasets import NAME SRC -o FILE``.

Each module has ``load(source, **options) -> Recording``; ``source`` is the packaged npz, or a folder that holds one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from tbmfg.errors import TbmfgError
from tbmfg.rig import Rig, dump_rig, load_rig
from tbmfg.timeseries import NS, Clouds, Floats, Series, Times

G = 9.80665  # m/s^2 in a g


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording's topics in ROS units, a rig that fits them, and log times by topic where they are known."""

    log_series: tuple[Series, ...]
    rig: Rig
    log_ns: Mapping[str, Times] = field(default_factory=dict)
    clouds: tuple[Clouds, ...] = ()

    def write(self, path: str | Path) -> None:
        """Write the MCAP log, its rig attached: without the sensors, but for the IMU, that this recording lacks."""
        from tbmfg.mcap import write_log

        topics = {part.topic for part in (*self.log_series, *self.clouds)}
        kept = {name: sensor for name, sensor in self.rig.sensors.items() if sensor.topic in topics or name == "imu"}
        truth = self.rig.truth if self.rig.truth and self.rig.truth.topic in topics else None
        rig = self.rig.model_copy(update={"sensors": kept, "truth": truth})
        attached = {"rig.yaml": dump_rig(rig).encode()}
        write_log(path, self.log_series, clouds=self.clouds, attachments=attached, log_ns=self.log_ns)


class Arrays(dict):
    """The arrays of an npz file by name; one that is missing is the file's fault, said in one line."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray]) -> None:
        super().__init__(arrays)
        self.path = path

    def __missing__(self, name: str) -> np.ndarray:
        raise TbmfgError(f"{self.path}: lacks the array {name}; it holds {', '.join(sorted(self)) or 'nothing'}")


def read_npz(source: str | Path) -> Arrays:
    """The arrays of ``source``, a file, or a folder with exactly one npz."""
    path = Path(source)
    if path.is_dir():
        inside = sorted(path.glob("*.npz"))
        if len(inside) != 1:
            names = f" ({', '.join(file.name for file in inside)})" if inside else ""
            raise TbmfgError(f"{path}: {len(inside)} npz files{names}; name one")
        path = inside[0]
    with _readable(path), np.load(path) as arrays:
        return Arrays(path, dict(arrays))


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise TbmfgError(f"{path}: is not a readable npz file: {error}") from None


def rig_of(name: str) -> Rig:
    """The rig of a recording that tbmfg ships none for."""
    return load_rig(Path(__file__).parent / f"{name}.yaml")


def stamps(t_s: Floats, t0_ns: int = 0) -> Times:
    """Times in s since ``t0_ns`` as stamps."""
    return t0_ns + np.round(t_s * NS).astype(np.int64)


def imu(topic: str, t_ns: Times, gyro: Floats, acc: Floats) -> Series:
    """``gyro`` rad/s and ``acc`` m/s^2, (n, 3) each."""
    return Series(topic, "sensor_msgs/msg/Imu", t_ns, {"gyro": gyro, "acc": acc}, "imu")


def fixes(topic: str, t_ns: Times, llh_deg: Floats, sd_enu: Floats, status: np.ndarray | int = 0) -> Series:
    """Satellite fixes: degrees and m, standard deviations (n, 3) in m; ``status`` as in NavSatStatus."""
    cov = np.zeros((len(t_ns), 9))
    cov[:, [0, 4, 8]] = sd_enu**2
    diagonal_known = np.full(len(t_ns), 2.0)
    columns = {"llh": llh_deg, "cov": cov, "cov_type": diagonal_known, "status": np.zeros(len(t_ns)) + status}
    return Series(topic, "sensor_msgs/msg/NavSatFix", t_ns, columns, "gnss")


def magnetic(topic: str, t_ns: Times, microtesla: Floats) -> Series:
    """A magnetometer, (n, 3)."""
    return Series(topic, "sensor_msgs/msg/MagneticField", t_ns, {"field": 1e-6 * microtesla}, "imu")


def pressure(topic: str, t_ns: Times, hectopascal: Floats) -> Series:
    """A barometer, (n,)."""
    return Series(topic, "sensor_msgs/msg/FluidPressure", t_ns, {"pressure": 100.0 * hectopascal}, "imu")


def poses(topic: str, t_ns: Times, position: Floats, quat_xyzw: Floats | None = None) -> Series:
    """Truth as PoseStamped; without attitude its quaternions are zero."""
    quat = np.zeros((len(t_ns), 4)) if quat_xyzw is None else quat_xyzw
    return Series(topic, "geometry_msgs/msg/PoseStamped", t_ns, {"position": position, "quat_xyzw": quat}, "n")
