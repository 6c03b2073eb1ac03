"""A spinning LiDAR in a world of triangles, in clean air and in dust.

Every point is seen from where the LiDAR is at that point's own time: a scan of a moving, shaking machine is distorted
as a real one is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datasets.simulate import START_NS, Scene, Sensed
from datasets.worlds import Mesh
from tbmfg.rig import Lidar
from tbmfg.timeseries import NS, Floats, StreamCounts, Times

BEAMS = 16
ELEVATION_DEG = 15.0  # of the outer beams
SHORTEST_M, LONGEST_M = 0.5, 100.0
SIGMA_M = 0.03
FALSE_SHARE = 0.3  # of the light that dust scatters, what is bright enough to be taken for an echo
BATCH = 10  # scans cast at once
NODE_S = 5e-4  # between the poses that are computed

# Extinction of the air at times (n,) s, 1/m
Dust = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True)
class Scans:
    """Scans of one LiDAR, cast anew in each iteration; header stamps are those of the scans' starts.

    Fields: x, y, z m and intensity (float32), ring (uint16), time (float32): s since the stamp. Rays without an echo
    are not in the cloud. The LiDAR is at ``xyz_b`` (3,) m in b, ``R_bl`` takes its axes there. Dust after Beer and
    Lambert: light comes back over a range r with probability exp(-2 k r); what does not was scattered on the way,
    and a share of it is an echo from there.
    """

    topic: str
    since_ns: Times  # starts of the scans since the log's
    scene: Scene
    xyz_b: Floats
    R_bl: Floats
    world: Mesh
    seed: int
    period_s: float
    columns: int
    sigma_m: float = SIGMA_M
    dust: Dust | None = None
    offset_ns: int = 0
    frame_id: str = "lidar"
    counts: StreamCounts = field(default_factory=StreamCounts)

    def __len__(self) -> int:
        return len(self.since_ns)

    @property
    def t_ns(self) -> Times:
        """Header stamps, (n,)."""
        return START_NS + self.offset_ns + self.since_ns

    def __iter__(self) -> Iterator[tuple[int, dict[str, NDArray]]]:
        scene = raycasting(self.world)
        elevation = np.radians(np.linspace(-ELEVATION_DEG, ELEVATION_DEG, BEAMS))
        azimuth = -2 * np.pi * np.arange(self.columns) / self.columns  # clockwise from above, as such units turn
        direction = np.stack(  # (columns, beams, 3) in the LiDAR's axes
            [
                np.cos(azimuth)[:, None] * np.cos(elevation),
                np.sin(azimuth)[:, None] * np.cos(elevation),
                np.broadcast_to(np.sin(elevation), (self.columns, BEAMS)),
            ],
            axis=2,
        )
        after = np.arange(self.columns) * (self.period_s / self.columns)
        cuts = [*range(0, len(self), BATCH), len(self)]
        for first, last in pairwise(cuts):
            start_s = self.since_ns[first:last] * 1e-9
            origin, R = self._poses(start_s[:, None] + after)
            rays = np.empty((last - first, self.columns, BEAMS, 6), dtype=np.float32)
            rays[..., :3] = origin[:, :, None]
            rays[..., 3:] = direction @ R.swapaxes(2, 3)
            distance = scene.cast_rays(rays)["t_hit"].numpy()
            for k in range(first, last):
                rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(k,)))
                cloud = self._echoes(distance[k - first], direction, after, start_s[k - first], rng)
                yield int(self.t_ns[k]), cloud

    def _poses(self, t_s: Floats) -> tuple[Floats, Floats]:
        """The LiDAR in n at ``t_s`` (s, c): origins (s, c, 3) and rotations (s, c, 3, 3).

        Linear over half a millisecond: with accelerations of 2 m/s^2 that is exact to 0.1 micrometres.
        """
        nodes = max(2, int(np.ceil(np.ptp(t_s[0]) / NODE_S)) + 1)
        share = np.linspace(0.0, 1.0, nodes)
        truth = self.scene.motion((t_s[:, :1] + (t_s[:, -1:] - t_s[:, :1]) * share).ravel())
        origin, _ = truth.at_point(self.xyz_b)
        at = np.linspace(0.0, nodes - 1.0, t_s.shape[1])
        k = np.minimum(at.astype(int), nodes - 2)
        parts = []
        for values in (origin.reshape(len(t_s), nodes, 3), (truth.R @ self.R_bl).reshape(len(t_s), nodes, 9)):
            parts.append(values[:, k] + (at - k)[:, None] * (values[:, k + 1] - values[:, k]))
        return parts[0], parts[1].reshape(*t_s.shape, 3, 3)

    def _echoes(
        self, distance: NDArray, direction: Floats, after: Floats, start_s: float, rng: np.random.Generator
    ) -> dict[str, NDArray]:
        """One scan's cloud from the true distances (columns, beams)."""
        noise, fate, echo = rng.standard_normal(distance.shape), *rng.random((2, *distance.shape))
        distance = distance.astype(float)
        intensity = np.full(distance.shape, 100.0)
        if self.dust is not None:
            k = np.maximum(self.dust(start_s + after), 1e-9)[:, None]
            reach = -np.log(np.maximum(fate, 1e-300)) / (2 * k)  # how far light would come: exp(-2 k r) get beyond r
            scattered = reach < distance
            distance = np.where(scattered, np.where(echo < FALSE_SHARE, reach, np.inf), distance)
            intensity[scattered] = 5.0
        distance = distance + self.sigma_m * noise
        column, beam = np.nonzero((distance > SHORTEST_M) & (distance < LONGEST_M))
        points = (direction[column, beam] * distance[column, beam, None]).astype(np.float32)
        return {
            **{axis: points[:, a] for a, axis in enumerate("xyz")},
            "intensity": intensity[column, beam].astype(np.float32),
            "ring": beam.astype(np.uint16),
            "time": after[column].astype(np.float32),
        }


def lidar(
    scene: Scene,
    sensor: Lidar,
    rng: np.random.Generator,
    *,
    world: Mesh,
    rate_hz: float = 10.0,
    columns: int = 1800,
    dust: Dust | None = None,
) -> Sensed:
    """Scans from the log's start to its end, 16 beams of ``columns`` points each.

    The mounting is the rig's plus errors drawn from its standard deviations: ``xyz_m``, and ``turn_deg``, a rotation
    vector about the axes that the rig gives the LiDAR.
    """
    count = int(scene.duration_s * rate_hz + 1e-6)
    since_ns = np.round(np.arange(count) * (NS / rate_hz)).astype(np.int64)
    seed, (shift, turn) = int(rng.integers(2**63)), rng.standard_normal((2, 3))
    drawn = {"xyz_m": sensor.T_bl.xyz + sensor.xyz_sd * shift, "turn_deg": np.rad2deg(sensor.rpy_sd) * turn}
    R_bl = sensor.T_bl.R @ Rotation.from_rotvec(drawn["turn_deg"], degrees=True).as_matrix()
    scans = Scans(
        sensor.topic, since_ns, scene, drawn["xyz_m"], R_bl, world, seed, 1 / rate_hz, columns, dust=dust,
        offset_ns=round(sensor.clock_offset_s * NS), counts=StreamCounts(received=count),
    )  # fmt: skip
    return Sensed(scans, replace(scans, sigma_m=0.0, dust=None, offset_ns=0), drawn)


def raycasting(world: Mesh):
    """Open3D's scene of a mesh. Its library wants libusb, which a bare machine lacks: the wheel's is loaded first."""
    import ctypes

    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(world.vertices.astype(np.float32), world.triangles.astype(np.uint32))
    return scene
