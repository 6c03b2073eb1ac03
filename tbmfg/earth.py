"""The Earth under the navigation frame: gravity, its rotation, and coordinates on the WGS 84 ellipsoid.

``llh`` is geodetic latitude and longitude [rad] and height above the ellipsoid [m], (..., 3). The navigation
frame n lies at ``origin_llh`` (3,): z along the ellipsoid's normal, x ``x_axis_azimuth`` rad clockwise from north.
"""

from __future__ import annotations

import numpy as np

from tbmfg.timeseries import Floats

RATE = 7.292115e-5  # rad/s, WGS 84
RADIUS = 6_378_137.0  # m, semi-major axis, WGS 84
FLATTENING = 1 / 298.257223563  # WGS 84
ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)


def gravity(latitude: float, height: float = 0.0) -> float:
    """Normal gravity [m/s^2] at ``latitude`` rad and ``height`` m; Somigliana, WGS 84, free-air gradient."""
    s2 = np.sin(latitude) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - ECCENTRICITY_2 * s2)
    return surface * (1 - 2 * height / RADIUS)


def rate_n(latitude: float, x_axis_azimuth: float) -> Floats:
    """Earth rate in n [rad/s], (3,): n's x axis lies ``x_axis_azimuth`` rad clockwise from north, z up."""
    north, up = RATE * np.cos(latitude), RATE * np.sin(latitude)
    return np.array([north * np.cos(x_axis_azimuth), north * np.sin(x_axis_azimuth), up])


def north_direction(x_axis_azimuth: float) -> float:
    """Angle of north in n, counter-clockwise from n's x axis, rad: 90 degrees of azimuth (ENU) give +90."""
    return x_axis_azimuth


# ---- the ellipsoid ----


def ecef_from_llh(llh: Floats) -> Floats:
    """Earth-centred Earth-fixed coordinates [m], (..., 3); Groves (2013) eq. 2.112."""
    latitude, longitude, height = np.moveaxis(np.asarray(llh, dtype=float), -1, 0)
    normal = RADIUS / np.sqrt(1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    from_axis = (normal + height) * np.cos(latitude)
    z = ((1 - ECCENTRICITY_2) * normal + height) * np.sin(latitude)
    return np.stack([from_axis * np.cos(longitude), from_axis * np.sin(longitude), z], axis=-1)


def llh_from_ecef(ecef: Floats) -> Floats:
    """Latitude, longitude, height of Earth-centred Earth-fixed coordinates [m], (..., 3).

    Bowring (1976) for the parametric latitude; three rounds are exact to rounding from the core up to satellites.
    """
    x, y, z = np.moveaxis(np.asarray(ecef, dtype=float), -1, 0)
    from_axis = np.hypot(x, y)
    polar = RADIUS * (1 - FLATTENING)
    parametric = np.arctan2(z, (1 - FLATTENING) * from_axis)
    for _ in range(3):
        latitude = np.arctan2(
            z + ECCENTRICITY_2 / (1 - ECCENTRICITY_2) * polar * np.sin(parametric) ** 3,
            from_axis - ECCENTRICITY_2 * RADIUS * np.cos(parametric) ** 3,
        )
        parametric = np.arctan2((1 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    sine = np.sin(latitude)
    # along the normal: holds at the poles, where from_axis / cos(latitude) does not
    height = from_axis * np.cos(latitude) + z * sine - RADIUS * np.sqrt(1 - ECCENTRICITY_2 * sine**2)
    return np.stack([latitude, np.arctan2(y, x), height], axis=-1)


def R_ne(latitude: float, longitude: float, x_axis_azimuth: float) -> Floats:
    """Rotation from Earth-fixed axes to n, (3, 3)."""
    (sin_lat, cos_lat), (sin_lon, cos_lon) = ((np.sin(a), np.cos(a)) for a in (latitude, longitude))
    east_e = np.array([-sin_lon, cos_lon, 0.0])
    north_e = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    up_e = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    return R_from_enu(x_axis_azimuth) @ np.stack([east_e, north_e, up_e])


def R_from_enu(x_axis_azimuth: float) -> Floats:
    """Rotation from east-north-up to n, (3, 3)."""
    s, c = np.sin(x_axis_azimuth), np.cos(x_axis_azimuth)
    return np.array([[s, c, 0.0], [-c, s, 0.0], [0.0, 0.0, 1.0]])


def n_from_llh(llh: Floats, origin_llh: Floats, x_axis_azimuth: float) -> Floats:
    """Positions in n [m], (..., 3)."""
    R = R_ne(origin_llh[0], origin_llh[1], x_axis_azimuth)
    return (ecef_from_llh(llh) - ecef_from_llh(origin_llh)) @ R.T


def llh_from_n(position_n: Floats, origin_llh: Floats, x_axis_azimuth: float) -> Floats:
    """Latitude, longitude, height of positions in n [m], (..., 3)."""
    R = R_ne(origin_llh[0], origin_llh[1], x_axis_azimuth)
    return llh_from_ecef(np.asarray(position_n) @ R + ecef_from_llh(origin_llh))
