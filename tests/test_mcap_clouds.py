"""Point clouds: every field in its own type, one cloud in memory at a time."""

import struct
import tracemalloc
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from mcap.writer import Writer
from mcap_samples import START_NS, sample, stock_decoded
from rosbags.typesys import Stores, get_typestore

from tbmfg.errors import LogError
from tbmfg.mcap import read_log, write_log
from tbmfg.mcap.cdr import CdrWriter
from tbmfg.mcap.clouds import decode_cloud, encode_cloud
from tbmfg.mcap.schemas import definition
from tbmfg.timeseries import StreamCounts

CODES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


@dataclass
class Scans:
    """Clouds made as they are asked for."""

    topic: str
    t_ns: np.ndarray
    points: int
    frame_id: str = "lidar"

    def __len__(self):
        return len(self.t_ns)

    def __iter__(self):
        for i, t_ns in enumerate(self.t_ns):
            yield int(t_ns), scan(i, self.points)


def scan(seed, n):
    rng = np.random.default_rng(seed)
    return {
        **{axis: rng.normal(size=n).astype("f4") for axis in "xyz"},
        "intensity": rng.integers(0, 255, n).astype("u1"),
        "t": rng.integers(0, 10**8, n).astype("u4"),
        "ring": rng.integers(0, 64, n).astype("u2"),
        "covariance": rng.normal(size=(n, 6)),
    }


def assert_same_fields(fields, expected):
    assert list(fields) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(fields[name], values, strict=True)


@pytest.mark.parametrize("options", [{}, {"compression": "lz4"}, {"compression": "none"}, {"chunked": False}])
def test_clouds_come_back_field_by_field(tmp_path, options):
    t_ns = START_NS + np.arange(12) * 100_000_000
    path = tmp_path / "x.mcap"
    write_log(path, [sample("sensor_msgs/msg/Imu", 300)], clouds=[Scans("/points", t_ns, 200)], **options)
    clouds = read_log(path).clouds["/points"]
    np.testing.assert_array_equal(clouds.t_ns, t_ns)
    assert len(clouds) == 12
    assert clouds.frame_id == "lidar"
    for _ in range(2):  # a second look reads the file again
        for i, (stamp, fields) in enumerate(clouds):
            assert stamp == t_ns[i]
            assert_same_fields(fields, scan(i, 200))


def test_clouds_out_of_order_and_repeated(tmp_path):
    t_ns = START_NS + np.array([3, 1, 2, 2, 5])
    path = tmp_path / "x.mcap"
    write_log(path, [], clouds=[Scans("/points", t_ns, 3)], log_ns={"/points": START_NS + np.arange(5)})
    clouds = read_log(path).clouds["/points"]
    assert clouds.counts == StreamCounts(received=5, duplicate=1, disordered=1)
    assert [t - START_NS for t, _ in clouds] == [1, 2, 3, 5]
    assert_same_fields(next(iter(clouds))[1], scan(1, 3))


def test_only_one_cloud_is_in_memory(tmp_path):
    """A cloud of 20 000 points takes 1.3 MB, all forty of them 54 MB."""
    path = tmp_path / "x.mcap"
    write_log(path, [], clouds=[Scans("/points", np.arange(40) * 10**8, 20_000)], compression="none")
    assert path.stat().st_size > 50e6
    tracemalloc.start()
    count = sum(len(fields["x"]) for _, fields in read_log(path).clouds["/points"])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 800_000
    assert peak < 12e6


def test_a_file_that_changes_under_the_clouds_is_noticed(tmp_path):
    path = tmp_path / "x.mcap"
    write_log(path, [], clouds=[Scans("/points", np.arange(4), 50)])
    clouds = read_log(path).clouds["/points"]
    broken = bytearray(path.read_bytes())
    broken[len(broken) // 3] ^= 0xFF
    path.write_bytes(broken)
    with pytest.raises(LogError, match="not intact"):
        list(clouds)


def test_malformed_clouds_are_counted(tmp_path):
    sound = encode_cloud(START_NS, "lidar", scan(0, 5))
    path = tmp_path / "x.mcap"
    writer = Writer(str(path))
    writer.start("ros2", "test")
    schema = writer.register_schema(
        "sensor_msgs/msg/PointCloud2", "ros2msg", definition("sensor_msgs/msg/PointCloud2").encode()
    )
    channel = writer.register_channel("/points", "cdr", schema)
    for payload in (
        sound,
        sound[:-40],
        b"",
        cloud(width=9),
        cloud(fields=[("x", 2, 7, 1)]),
        cloud(fields=[("x", 0, 9, 1)]),
    ):
        writer.add_message(channel, 0, payload, 0)
    writer.finish()
    clouds = read_log(path).clouds["/points"]
    assert clouds.counts == StreamCounts(received=1, undecodable=5)


# ---- single messages ----


def cloud(height=1, width=2, fields=(("x", 0, 7, 1),), big=False, point_step=4, row_step=8, data=bytes(8)):
    cdr = CdrWriter().header(5, "f").scalars("I", height, width, len(fields))
    for name, offset, datatype, count in fields:
        cdr.string(name).scalars("I", offset).scalars("B", datatype).scalars("I", count)
    cdr.scalars("B", big).scalars("I", point_step, row_step, len(data)).octets(data)
    return cdr.scalars("B", True).message()


def test_organised_cloud_with_padded_rows():
    rows = [struct.pack("<2f", 1, 2) + b"pad!", struct.pack("<2f", 3, 4) + b"pad!"]
    t_ns, frame_id, fields = decode_cloud(cloud(height=2, row_step=12, data=b"".join(rows)))
    assert (t_ns, frame_id) == (5, "f")
    np.testing.assert_array_equal(fields["x"], np.array([1, 2, 3, 4], dtype="f4"), strict=True)


def test_big_endian_points_become_native():
    _, _, fields = decode_cloud(cloud(big=True, data=struct.pack(">2f", 1.5, -2.5)))
    np.testing.assert_array_equal(fields["x"], np.array([1.5, -2.5], dtype="f4"), strict=True)


@pytest.mark.parametrize(("count", "row_step"), [(0, 8), (1, 0)])
def test_zero_where_drivers_leave_it(count, row_step):
    """A count of 0 means 1, and the row step of a single row is known."""
    _, _, fields = decode_cloud(cloud(fields=[("x", 0, 7, count)], row_step=row_step, data=struct.pack("<2f", 7, 8)))
    np.testing.assert_array_equal(fields["x"], [7, 8])


def test_fields_are_views_of_the_message():
    payload = cloud()
    _, _, fields = decode_cloud(payload)
    assert not fields["x"].flags.owndata
    assert np.shares_memory(fields["x"], np.frombuffer(payload, dtype="u1"))


def test_empty_cloud():
    _, _, fields = decode_cloud(encode_cloud(0, "", {"x": np.empty(0, "f4"), "n": np.empty((0, 3))}))
    assert fields["x"].shape == (0,)
    assert fields["n"].shape == (0, 3)


@settings(max_examples=60, deadline=None)
@given(drawn=st.data())
def test_any_fields_survive(drawn):
    n = drawn.draw(st.integers(0, 5))
    fields = {}
    for name in drawn.draw(st.lists(st.sampled_from(["x", "y", "t", "größe"]), min_size=1, unique=True)):
        shape = (n, *drawn.draw(array_shapes(min_dims=0, max_dims=1, min_side=2, max_side=4)))
        dtype = np.dtype(drawn.draw(st.sampled_from(CODES)))
        fields[name] = drawn.draw(arrays(dtype, shape))
    t_ns, frame_id, read = decode_cloud(encode_cloud(START_NS + 1, "odd", fields))
    assert (t_ns, frame_id) == (START_NS + 1, "odd")
    assert_same_fields(read, fields)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=120), st.integers(0, 150))
def test_garbage_is_refused_with_a_value_error(noise, at):
    payload = bytearray(encode_cloud(1, "f", scan(0, 2)))
    payload[at : at + len(noise)] = noise
    with suppress(ValueError):
        decode_cloud(payload)


def test_other_decoders_read_our_clouds(tmp_path):
    path = tmp_path / "x.mcap"
    write_log(path, [], clouds=[Scans("/points", np.array([START_NS]), 7)])
    (stock,) = stock_decoded(path, {"/points"})["/points"]
    assert (stock.height, stock.width, stock.is_dense, stock.is_bigendian) == (1, 7, True, False)
    assert [field.name for field in stock.fields] == list(scan(0, 7))
    store = get_typestore(Stores.ROS2_HUMBLE)
    message = store.deserialize_cdr(encode_cloud(START_NS, "lidar", scan(0, 7)), "sensor_msgs/msg/PointCloud2")
    assert message.point_step * 7 == message.row_step == len(message.data)
    assert bytes(message.data) == bytes(stock.data)
