"""How good and how fast tbmfg is: ``python -m benchmarks NAME``, a table, and with ``--json FILE`` its rows.

Each benchmark is a module with

- ``options(parser)``     its own options
- ``measure(given)``      rows from the parsed options

and, where its metrics do not depend on the machine and can so be held to a committed baseline,

- ``GATE``                options of the run that the baseline holds
- ``tolerance(row)``      how far that row may move, or None where it is not held

A row is one metric of one estimator in one scenario; see :mod:`benchmarks.rows`.
"""

from __future__ import annotations

BENCHMARKS = {
    "accuracy": "benchmarks.accuracy",
    "outliers": "benchmarks.outliers",
    "attitude": "benchmarks.attitude",
    "euroc": "benchmarks.euroc",
    "clock": "benchmarks.clock",
    "outages": "benchmarks.outages",
    "gyrocompass": "benchmarks.gyrocompass",
    "reckoning": "benchmarks.reckoning",
    "height": "benchmarks.height",
    "speed": "benchmarks.speed",
    "scale": "benchmarks.scale",
    "pace": "benchmarks.pace",
    "lidar": "benchmarks.lidar",
    "scans": "benchmarks.scans",
    "maps": "benchmarks.maps",
    "papers": "benchmarks.papers",
}
