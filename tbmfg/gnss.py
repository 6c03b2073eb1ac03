"""Satellite fixes as positions in n, with the accuracy that the rig or the receiver states.

After this a fix is what a prism's is: a point of the machine, by an arm, on a clock of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tbmfg import earth
from tbmfg.errors import LogError, RigError
from tbmfg.rig import Gnss, Origin, Prism, Rig
from tbmfg.timeseries import Floats, Log, Series

ASSUMED_SIGMA_ENU = (5.0, 5.0, 10.0)  # m, of a receiver on its own that does not say: code positioning in the open
FAR_DEG = 0.1  # of latitude: 11 km, from which the rig's place and that of the fixes are two


def into_n(log: Log, rig: Rig) -> tuple[Log, Rig, list[str]]:
    """The log with fixes as ``point`` and ``sigma`` (n, 3) in n [m], the rig with its origin, and what to say.

    Messages without a fix (status below 0, or coordinates off the Earth) are dropped. Where the rig gives no
    longitude, n touches the Earth at the first fix in the log, whatever is hidden from the estimators later.
    """
    sensors = {name: sensor for name, sensor in rig.sensors.items() if isinstance(sensor, Gnss)}
    fixes = {name: _fixes(name, log.series[s.topic]) for name, s in sensors.items() if s.topic in log.series}
    located = [series for series in fixes.values() if len(series)]
    said = [
        f"{name}: {dropped} of {total} messages hold no fix"
        for name, series in fixes.items()
        if (dropped := (total := len(log.series[series.topic])) - len(series))
    ]
    if located:
        first = min(located, key=lambda series: series.t_ns[0])
        rig, more = _with_origin(rig, first["llh"][0])
        said += more
    converted = dict(log.series)
    for name, series in fixes.items():
        converted[series.topic], more = _converted(name, series, sensors[name], rig.origin)
        said += more
    return replace(log, series=converted), rig, said


def _fixes(name: str, series: Series) -> Series:
    """The messages that hold a fix."""
    if "llh" not in series.columns:
        raise LogError(f"{name}: {series.topic} is {series.type}; it should be sensor_msgs/msg/NavSatFix")
    latitude, longitude, _ = series["llh"].T
    return series.select((series["status"] >= 0) & (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360))


def _with_origin(rig: Rig, first_llh_deg: Floats) -> tuple[Rig, list[str]]:
    """The rig with n at the first fix, unless it places n itself."""
    given = rig.origin
    if given.llh is not None:
        return rig, []
    if any(isinstance(sensor, Prism) for sensor in rig.sensors.values()):
        raise RigError(
            "origin: latitude_deg, longitude_deg and height_m of the total station's frame are needed "
            "where a prism and gnss share it"
        )
    latitude, longitude, height = map(float, first_llh_deg)
    said = []
    if given.latitude_deg is None:
        said.append(f"origin is not given: n lies at the first fix, latitude {latitude:.6f}, longitude {longitude:.6f}")
    elif abs(given.latitude_deg - latitude) > FAR_DEG:
        said.append(f"origin.latitude_deg {given.latitude_deg:g} is not where the fixes are; taken is {latitude:.6f}")
    place = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    return rig.model_copy(update={"origin": given.model_copy(update=place)}), said


def _converted(name: str, series: Series, sensor: Gnss, origin: Origin) -> tuple[Series, list[str]]:
    """Fixes with ``point`` and ``sigma`` (n, 3) in n for their columns."""
    if not len(series):
        return replace(series, columns={"point": np.zeros((0, 3)), "sigma": np.zeros((0, 3))}), []
    llh = series["llh"] * [np.pi / 180, np.pi / 180, 1.0]
    point = earth.n_from_llh(llh, origin.llh, origin.x_axis_azimuth)
    said = []
    if sensor.sigma is not None:
        sigma = np.full_like(point, sensor.sigma)
    else:
        sigma, known = stated_sigma(series, origin.x_axis_azimuth)
        if not known.all():
            h, _, v = ASSUMED_SIGMA_ENU
            said.append(
                f"{name}: {(~known).sum()} of {len(series)} fixes do not say how accurate they are; taken as {h:g} m "
                f"horizontally and {v:g} m vertically; set sensors.{name}.sigma_m"
            )
    return replace(series, columns={"point": point, "sigma": sigma}), said


def stated_sigma(series: Series, x_axis_azimuth: float) -> tuple[Floats, np.ndarray]:
    """Standard deviation per axis of n [m], (n, 3), and whether it is known, (n,).

    From the covariance in the messages, which is about east, north and up; correlations between axes are left out.
    """
    R = earth.R_from_enu(x_axis_azimuth)
    cov_n = R @ series["cov"].reshape(-1, 3, 3) @ R.T
    variance = np.diagonal(cov_n, axis1=1, axis2=2)
    known = (series["cov_type"] > 0) & (variance > 0).all(axis=1) & np.isfinite(variance).all(axis=1)
    assumed = np.diag(R @ np.diag(np.square(ASSUMED_SIGMA_ENU)) @ R.T)
    return np.sqrt(np.where(known[:, None], variance, assumed)), known
