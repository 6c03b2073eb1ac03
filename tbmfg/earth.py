"""Gravity and Earth rate in the navigation frame."""

from __future__ import annotations

import numpy as np

from tbmfg.timeseries import Floats

RATE = 7.292115e-5  # rad/s, WGS 84


def gravity(latitude: float, height: float = 0.0) -> float:
    """Normal gravity [m/s^2] at ``latitude`` rad and ``height`` m; Somigliana, WGS 84, free-air gradient."""
    s2 = np.sin(latitude) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - 0.00669437999013 * s2)
    return surface * (1 - 2 * height / 6_378_137.0)


def rate_n(latitude: float, x_axis_azimuth: float) -> Floats:
    """Earth rate in n [rad/s], (3,): n's x axis lies ``x_axis_azimuth`` rad clockwise from north, z up."""
    north, up = RATE * np.cos(latitude), RATE * np.sin(latitude)
    return np.array([north * np.cos(x_axis_azimuth), north * np.sin(x_axis_azimuth), up])


def north_direction(x_axis_azimuth: float) -> float:
    """Angle of north in n, counter-clockwise from n's x axis, rad: 90 degrees of azimuth (ENU) give +90."""
    return x_axis_azimuth
