"""Reading logs: columns equal what the stock decoder gives, and every message is accounted for."""

import re
import struct
import time
import tracemalloc

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.writer import Writer
from mcap_samples import (
    CHILD_FRAMES,
    START_NS,
    WIDTHS,
    assert_same,
    data,
    sample,
    samples,
    stock_columns,
    stock_decoded,
)
from rosbags.typesys import Stores, get_typestore

from tbmfg.errors import LogError
from tbmfg.mcap import read_log, write_log
from tbmfg.mcap.layouts import LAYOUTS, decode, encode
from tbmfg.mcap.schemas import definition, full_name
from tbmfg.mcap.writer import encode_transforms
from tbmfg.timeseries import Series, StreamCounts, Transform

RECORDINGS = [
    "euroc_mh01_imu_leica.mcap",
    "husky_imu_odom_fix.mcap",
    "nav2_turtlebot.mcap",
    "xsens_mtig_imu_mag_gps_scan.mcap",
]
IMU, POINT, ODOMETRY = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PointStamped", "nav_msgs/msg/Odometry"
STATIC = (
    Transform("base_link", "imu", (0.1, -0.2, 0.3), (0.0, 0.0, 0.0, 1.0)),
    Transform("base_link", "prism", (1.0, 2.0, 3.0), (0.5, -0.5, 0.5, -0.5)),
)


def write_raw(path, channels, chunked=True, **options):
    """``channels``: (topic, type, schema encoding, message encoding, payloads); log times are 0, 1, 2, ..."""
    writer = Writer(str(path), use_chunking=chunked, **options)
    writer.start("ros2", "test")
    log_ns = 0
    for topic, type, schema_encoding, message_encoding, payloads in channels:
        known = full_name(type) in WIDTHS or "tf2" in type
        text = definition(full_name(type)) if known else "float64 x"
        schema = writer.register_schema(type, schema_encoding, text.encode())
        channel = writer.register_channel(topic, message_encoding, schema)
        for payload in payloads:
            writer.add_message(channel, log_ns, payload, log_ns)
            log_ns += 1
    writer.finish()


def payloads_of(series):
    strings = {"frame_id": series.frame_id, "child_frame_id": series.child_frame_id}
    return encode(LAYOUTS[series.type], series.t_ns, series.columns, strings)


def points(t_ns, values=None):
    t_ns = np.asarray(t_ns, dtype=np.int64)
    values = np.arange(3.0 * len(t_ns)).reshape(-1, 3) if values is None else values
    return Series("/prism", POINT, t_ns, {"point": values}, "station")


# ---- the same values as the stock decoder ----


@pytest.mark.parametrize("name", RECORDINGS)
def test_columns_of_real_recordings_equal_the_stock_decoder(name):
    path = data(name)
    log = read_log(path)
    assert log.damage == ()
    assert len(log.series) >= 2
    stock = stock_decoded(path, set(log.series))
    for topic, series in log.series.items():
        rows = {}
        for message in stock[topic]:  # the first of each stamp, as the reader keeps it
            stamp = message.header.stamp
            rows.setdefault(stamp.sec * 10**9 + stamp.nanosec, stock_columns(series.type, message))
        order = sorted(rows)
        assert series.counts.received == len(stock[topic]) == len(rows) + series.counts.duplicate
        np.testing.assert_array_equal(series.t_ns, order)
        for column, values in series.columns.items():
            np.testing.assert_array_equal(values, [rows[t][column] for t in order], err_msg=f"{topic} {column}")
        assert series.frame_id == stock[topic][0].header.frame_id


def test_columns_of_every_type_equal_the_stock_decoder(tmp_path):
    path = tmp_path / "all.mcap"
    written = samples()
    write_log(path, written)
    stock = stock_decoded(path, {series.topic for series in written})
    log = read_log(path)
    for series in written:
        rows = [stock_columns(series.type, message) for message in stock[series.topic]]
        for column in rows[0]:
            np.testing.assert_array_equal(log.series[series.topic][column], [row[column] for row in rows])


def decoded(layout, payloads):
    sizes = np.array([len(payload) for payload in payloads], dtype=np.int64)
    return decode(layout, np.frombuffer(b"".join(payloads), np.uint8), sizes)


@pytest.mark.parametrize("type", WIDTHS)
def test_big_endian_messages_give_the_same_columns(type):
    store = get_typestore(Stores.ROS2_HUMBLE)
    series = sample(type, 20, frame_id="a frame of odd length")
    little = payloads_of(series)
    big = [bytes(store.serialize_cdr(store.deserialize_cdr(p, type), type, little_endian=False)) for p in little]
    assert big[0][:2] == b"\0\0"
    rows = decoded(LAYOUTS[type], big)
    np.testing.assert_array_equal(rows.t_ns, series.t_ns)
    assert rows.strings["frame_id"] == series.frame_id
    for name, values in series.columns.items():
        np.testing.assert_array_equal(rows.columns[name], values)


@pytest.mark.parametrize("type", WIDTHS)
@settings(max_examples=25, deadline=None)
@given(drawn=st.data())
def test_decoding_undoes_encoding(type, drawn):
    n = drawn.draw(st.integers(1, 4))
    t_ns = drawn.draw(arrays(np.int64, n, elements=st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)))
    text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)
    strings = {"frame_id": drawn.draw(text)}
    if type in CHILD_FRAMES:
        strings["child_frame_id"] = drawn.draw(text)
    columns = {
        name: drawn.draw(arrays(float, (n, width) if width > 1 else n, elements=st.floats(width=64)))
        for name, width in WIDTHS[type].items()
        if name not in ("status", "cov_type")
    }
    payloads = encode(LAYOUTS[type], t_ns, columns, strings)
    rows = decoded(LAYOUTS[type], payloads)
    assert rows.good.all()
    assert rows.strings == strings
    np.testing.assert_array_equal(rows.t_ns, t_ns)
    for name, values in columns.items():
        np.testing.assert_array_equal(rows.columns[name], values)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=400), max_size=6), st.sampled_from(sorted(WIDTHS)), st.randoms())
def test_garbage_among_messages_is_left_out(garbage, type, random):
    series = sample(type, 5)
    payloads = [*payloads_of(series), *garbage, *[payload[:-9] for payload in payloads_of(series)]]
    places = list(range(len(payloads)))
    random.shuffle(places)
    rows = decoded(LAYOUTS[type], [payloads[i] for i in places])
    t_ns = dict(zip(np.flatnonzero(rows.good), rows.t_ns, strict=True))
    for where, i in enumerate(places):
        if i < 5:
            assert t_ns[where] == series.t_ns[i]
        elif i >= 5 + len(garbage):
            assert where not in t_ns


def test_frame_ids_of_different_length_on_one_topic():
    short, long = sample(IMU, 6, frame_id="a"), sample(IMU, 6, frame_id="a much longer frame")
    mixed = [p for pair in zip(payloads_of(short), payloads_of(long), strict=True) for p in pair]
    rows = decoded(LAYOUTS[IMU], mixed)
    np.testing.assert_array_equal(rows.columns["gyro"], np.repeat(short["gyro"], 2, axis=0))


def test_frame_and_child_frame_that_differ_while_the_size_agrees():
    """The layout follows from both lengths, not from the size of the message."""
    series = sample(ODOMETRY, 4)
    layout, first = LAYOUTS[ODOMETRY], {"frame_id": "abcdefgh", "child_frame_id": "ij"}
    second = {"frame_id": "ab", "child_frame_id": "cdefghij"}
    payloads = [encode(layout, series.t_ns, series.columns, strings) for strings in (first, second)]
    assert len(payloads[0][0]) == len(payloads[1][0])
    rows = decoded(layout, payloads[0] + payloads[1])
    np.testing.assert_array_equal(rows.columns["position"], np.vstack([series["position"]] * 2))


def test_trailing_bytes_are_padding():
    series = sample(POINT, 3)
    rows = decoded(LAYOUTS[POINT], [payload + bytes(3) for payload in payloads_of(series)])
    np.testing.assert_array_equal(rows.columns["point"], series["point"])


# ---- every message is accounted for ----


def test_disorder_and_duplicates_are_counted_and_put_right(tmp_path):
    t_ns = START_NS + np.array([0, 10, 30, 20, 20, 40, 10, 50])
    write_log(tmp_path / "x.mcap", [points(t_ns)], log_ns={"/prism": START_NS + np.arange(8)})
    series = read_log(tmp_path / "x.mcap").series["/prism"]
    assert series.counts == StreamCounts(received=8, duplicate=2, disordered=2)
    assert series.counts.first_ns == {"duplicate": START_NS + 20, "disordered": START_NS + 20}
    np.testing.assert_array_equal(series.t_ns - START_NS, [0, 10, 20, 30, 40, 50])
    np.testing.assert_array_equal(series["point"][:, 0] / 3, [0, 1, 3, 2, 5, 7])  # the first of each stamp


def test_rows_that_are_not_finite_are_counted_and_removed(tmp_path):
    imu = sample(IMU, 10)
    imu["gyro"][2, 1] = np.nan
    imu["acc"][5, 0] = np.inf
    imu["acc"][5, 1] = np.nan
    write_log(tmp_path / "x.mcap", [imu])
    series = read_log(tmp_path / "x.mcap").series[imu.topic]
    assert series.counts == StreamCounts(received=10, nonfinite=2)
    assert_same(series, imu.select(np.delete(np.arange(10), [2, 5])))


def test_a_sound_row_survives_a_broken_one_of_the_same_stamp(tmp_path):
    values = np.array([[np.nan, 0, 0], [1, 2, 3], [4, 5, 6]])
    write_log(tmp_path / "x.mcap", [points([5, 5, 5], values)])
    series = read_log(tmp_path / "x.mcap").series["/prism"]
    assert series.counts == StreamCounts(received=3, nonfinite=1, duplicate=1)
    np.testing.assert_array_equal(series["point"], [[1, 2, 3]])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 13), st.booleans()), min_size=1, max_size=30))
def test_counts_add_up(tmp_path_factory, rows):
    t_ns = np.array([t for t, _ in rows])
    values = np.array([[i, 0, np.nan if broken else 0] for i, (_, broken) in enumerate(rows)], dtype=float)
    path = tmp_path_factory.mktemp("counts") / "x.mcap"
    write_log(path, [points(t_ns, values)], log_ns={"/prism": np.arange(len(t_ns))})
    series = read_log(path).series["/prism"]
    counts = series.counts
    assert counts.received == len(rows)
    assert counts.nonfinite == sum(broken for _, broken in rows)
    assert counts.disordered == int((np.diff(t_ns) < 0).sum())
    assert len(series) == counts.received - counts.duplicate - counts.nonfinite
    first = {t: i for i, (t, broken) in reversed(list(enumerate(rows))) if not broken}
    np.testing.assert_array_equal(series.t_ns, sorted(first))
    np.testing.assert_array_equal(series["point"][:, 0], [first[t] for t in sorted(first)])


def test_messages_that_do_not_decode_are_counted(tmp_path):
    imu = sample(IMU, 6)
    broken = [*payloads_of(imu), b"", b"\0\1\0\0", payloads_of(imu)[0][:200], b"\0\7\0\0" + bytes(320)]
    write_raw(tmp_path / "x.mcap", [(imu.topic, IMU, "ros2msg", "cdr", broken)])
    series = read_log(tmp_path / "x.mcap").series[imu.topic]
    assert series.counts == StreamCounts(received=6, undecodable=4)
    assert_same(series, imu)


# ---- fields that a publisher leaves empty ----


def test_imu_orientation_that_is_absent_is_no_column(tmp_path):
    imu = sample(IMU, 5)
    del imu.columns["quat_xyzw"]  # written as covariance[0] = -1
    write_log(tmp_path / "x.mcap", [imu])
    assert_same(read_log(tmp_path / "x.mcap").series[imu.topic], imu)


@pytest.mark.parametrize("quat", [[0, 0, 0, 0], [np.nan] * 4, [1, 1, 1, 1]])
def test_imu_orientation_that_is_none_is_no_column_and_costs_no_rows(tmp_path, quat):
    imu = sample(IMU, 5)
    imu["quat_xyzw"][3] = quat
    write_log(tmp_path / "x.mcap", [imu])
    series = read_log(tmp_path / "x.mcap").series[imu.topic]
    assert series.counts == StreamCounts(received=5)
    assert set(series.columns) == {"gyro", "acc"}


@pytest.mark.parametrize(("column", "value"), [("linear", np.nan), ("position", np.nan), ("quat_xyzw", 0.0)])
def test_a_part_of_an_odometry_that_is_never_filled_is_no_column(tmp_path, column, value):
    odometry = sample(ODOMETRY, 8)
    odometry[column][:] = value
    odometry["angular"][2, 0] = np.nan  # whereas this is a broken row
    write_log(tmp_path / "x.mcap", [odometry])
    series = read_log(tmp_path / "x.mcap").series[odometry.topic]
    assert column not in series.columns
    assert series.counts == StreamCounts(received=8, nonfinite=1)


def test_covariances_may_hold_anything(tmp_path):
    odometry = sample(ODOMETRY, 8)
    odometry["pose_cov"][:] = np.nan
    write_log(tmp_path / "x.mcap", [odometry])
    assert_same(read_log(tmp_path / "x.mcap").series[odometry.topic], odometry)


def test_an_imu_without_one_finite_row_is_an_empty_series_with_its_columns(tmp_path):
    imu = sample(IMU, 4)
    imu["acc"][:] = np.nan
    write_log(tmp_path / "x.mcap", [imu])
    series = read_log(tmp_path / "x.mcap").series[imu.topic]
    assert len(series) == 0
    assert series["acc"].shape == series["gyro"].shape == (0, 3)


# ---- what is read and what is passed over ----


def test_unknown_types_are_listed_and_skipped():
    log = read_log(data("xsens_mtig_imu_mag_gps_scan.mcap"))
    assert log.unknown["/info_gps"] == "xsens_mtig/msg/GPSInfoStatus2"
    assert "/scan" in log.unknown
    assert "/tf" not in log.unknown  # understood, though it is no series
    assert set(log.series) == {"/imu_data", "/position_gps", "/velocity"}


def test_static_transforms_of_a_real_recording():
    path = data("nav2_turtlebot.mcap")
    log = read_log(path, topics=["/odom"])
    assert set(log.series) == {"/odom"}
    (message,) = stock_decoded(path, {"/tf_static"})["/tf_static"]
    assert len(log.transforms) == len(message.transforms) == 29
    for ours, stock in zip(log.transforms, message.transforms, strict=True):
        assert (ours.parent, ours.child) == (stock.header.frame_id, stock.child_frame_id)
        move, turn = stock.transform.translation, stock.transform.rotation
        assert (*ours.xyz, *ours.quat_xyzw) == (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)


def test_the_last_static_transform_of_a_frame_counts(tmp_path):
    moved = Transform("base_link", "imu", (9.0, 0.0, 0.0), STATIC[0].quat_xyzw)
    messages = [encode_transforms(0, STATIC), encode_transforms(1, [moved]), b"\0\1\0\0\1\0\0\0"]
    write_raw(tmp_path / "x.mcap", [("/robot/tf_static", "tf2_msgs/msg/TFMessage", "ros2idl", "cdr", messages)])
    log = read_log(tmp_path / "x.mcap")
    assert log.transforms == (moved, STATIC[1])
    assert log.damage == ("/robot/tf_static: messages that cannot be decoded: 1",)


def test_encodings_that_are_not_read_are_named(tmp_path):
    imu = sample(IMU, 3)
    sound = payloads_of(imu)
    channels = [
        ("/ros1", IMU, "ros1msg", "ros1", sound),
        ("/proto", IMU, "protobuf", "cdr", sound),
        ("/custom", "acme/msg/Widget", "ros2msg", "cdr", sound),
        ("/idl", IMU, "ros2idl", "cdr", sound),
        ("/short", "sensor_msgs/Imu", "ros2msg", "cdr", sound),
    ]
    write_raw(tmp_path / "x.mcap", channels)
    log = read_log(tmp_path / "x.mcap")
    assert log.unknown == {
        "/ros1": f"{IMU} (message encoding 'ros1')",
        "/proto": f"{IMU} (schema encoding 'protobuf')",
        "/custom": "acme/msg/Widget",
    }
    for topic in ("/idl", "/short"):
        np.testing.assert_array_equal(log.series[topic]["gyro"], imu["gyro"])
        assert log.series[topic].type == IMU


def test_a_topic_of_two_types_keeps_the_first(tmp_path):
    imu, point = sample(IMU, 3), sample(POINT, 3)
    path = tmp_path / "x.mcap"
    both = [("/t", s.type, "ros2msg", "cdr", payloads_of(s)) for s in (imu, point)]
    write_raw(path, both)
    log = read_log(path)
    assert log.series["/t"].type == IMU
    assert log.damage == (f"x.mcap: /t is {IMU} and also {POINT}; the latter skipped",)


def test_two_publishers_on_one_topic_are_merged(tmp_path):
    odd, even = points([1, 3, 5]), points([2, 4, 6])
    path = tmp_path / "x.mcap"
    write_raw(path, [("/prism", POINT, "ros2msg", "cdr", payloads_of(s)) for s in (odd, even)])
    np.testing.assert_array_equal(read_log(path).series["/prism"].t_ns, range(1, 7))


def test_topics_narrow_what_is_read(tmp_path):
    written = samples()
    write_log(tmp_path / "x.mcap", written, transforms=STATIC, attachments={"rig.yaml": b"name: x\n"})
    log = read_log(tmp_path / "x.mcap", topics={written[0].topic, "/absent"})
    assert set(log.series) == {written[0].topic}
    assert log.unknown == {}
    assert log.transforms == STATIC
    assert log.attachments == {"rig.yaml": b"name: x\n"}


def test_progress_rises_to_one(tmp_path):
    write_log(tmp_path / "x.mcap", samples(500), chunk_size=10_000)
    seen = []
    read_log(tmp_path / "x.mcap", progress=seen.append)
    assert seen == sorted(seen)
    assert len(seen) > 10
    assert 0 <= seen[0] < 0.2
    assert seen[-1] == 1.0


# ---- rosbag2 folders ----


def split_bag(folder, series, parts, **information):
    """``series`` cut into files as rosbag2 splits them."""
    folder.mkdir()
    names = []
    for part, rows in enumerate(np.array_split(np.arange(len(series)), parts)):
        names.append(f"{folder.name}_{part}.mcap")
        write_log(folder / names[-1], [series.select(rows)], transforms=STATIC)
    information = {"storage_identifier": "mcap", "relative_file_paths": names, **information}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return [folder / name for name in names]


def test_split_bag_is_merged(tmp_path):
    imu = sample(IMU, 1000)
    split_bag(tmp_path / "bag", imu, 3)
    log = read_log(tmp_path / "bag")
    assert_same(log.series[imu.topic], imu)
    assert log.series[imu.topic].counts == StreamCounts(received=1000)
    assert log.transforms == STATIC  # repeated in every file


def test_split_bag_with_the_folder_in_its_paths(tmp_path):
    imu = sample(IMU, 10)
    split_bag(tmp_path / "bag", imu, 2, relative_file_paths=["bag/bag_0.mcap", "bag/bag_1.mcap"])
    assert_same(read_log(tmp_path / "bag").series[imu.topic], imu)


def test_split_bag_with_a_missing_and_an_alien_part(tmp_path):
    imu = sample(IMU, 40)
    files = split_bag(tmp_path / "bag", imu, 4)
    files[1].unlink()
    files[2].write_bytes(b"alien")
    log = read_log(tmp_path / "bag")
    assert_same(log.series[imu.topic], imu.select(np.r_[0:10, 30:40]))
    missing, alien = log.damage
    assert "bag_1.mcap" in missing
    assert "not an MCAP file" in alien


@pytest.mark.parametrize(
    ("information", "said"),
    [
        ({"storage_identifier": "sqlite3"}, "ros2 bag convert"),
        ({"compression_mode": "FILE", "compression_format": "zstd"}, "compressed by FILE"),
        ({"relative_file_paths": []}, "names no files"),
        ({"relative_file_paths": None}, "not a rosbag2 description"),
    ],
)
def test_folders_that_cannot_be_read_say_what_to_do(tmp_path, information, said):
    split_bag(tmp_path / "bag", sample(IMU, 10), 1, **information)
    refused(tmp_path / "bag", said)


def test_folder_without_metadata_is_refused_with_the_number_of_files(tmp_path):
    for file in split_bag(tmp_path / "bag", sample(IMU, 10), 2):
        assert file.exists()
    (tmp_path / "bag" / "metadata.yaml").write_text("]")
    refused(tmp_path / "bag", "ros2 bag reindex")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    refused(tmp_path / "bag", re.escape("(2 .mcap files in it)"))


def refused(path, said):
    with pytest.raises(LogError, match=said) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)


# ---- size ----


def test_imu_is_read_much_faster_than_by_the_stock_decoder(tmp_path):
    imu = sample(IMU, 8000)
    write_log(tmp_path / "x.mcap", [imu])
    read_log(tmp_path / "x.mcap")
    start = time.perf_counter()
    assert len(read_log(tmp_path / "x.mcap").series[imu.topic]) == 8000
    ours = time.perf_counter() - start
    start = time.perf_counter()
    assert len(stock_decoded(tmp_path / "x.mcap", {imu.topic})[imu.topic]) == 8000
    assert time.perf_counter() - start > 5 * ours  # about twenty times on an idle core


def test_memory_follows_the_data_not_the_file(tmp_path):
    """An Imu message has 320 bytes, its row 56 (88 with attitude)."""
    imu = sample(IMU, 70_000)
    del imu.columns["quat_xyzw"]
    path = write_repeated(tmp_path / "x.mcap", imu)
    tracemalloc.start()
    series = read_log(path).series[imu.topic]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert_same(series, imu)
    assert path.stat().st_size > 24e6
    assert peak < 20e6


def write_repeated(path, series):
    """One unchunked file put together by hand, since the stock writer takes seconds for it."""
    writer = Writer(str(path), use_chunking=False)
    writer.start("ros2", "test")
    schema = writer.register_schema(series.type, "ros2msg", definition(series.type).encode())
    channel = writer.register_channel(series.topic, "cdr", schema)
    writer.finish()
    head = path.read_bytes()
    head = head[: head.index(b"\x0f" + struct.pack("<Q", 4))]  # up to the DataEnd record
    with open(path, "wb") as file:
        file.write(head)
        for payload in payloads_of(series):
            file.write(struct.pack("<BQHIQQ", 5, 22 + len(payload), channel, 0, 0, 0) + payload)
        file.write(b"\x0f" + struct.pack("<QI", 4, 0))
        file.write(b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0) + b"\x89MCAP0\r\n")
    return path
