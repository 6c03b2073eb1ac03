"""Damaged files: what is intact is read and right, what is lost is said, and nothing ends in a traceback."""

import random
import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_samples import assert_same, sample

from tbmfg.errors import LogError
from tbmfg.mcap import read_log, write_log

IMU, POINT = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PointStamped"
DATA_END = b"\x0f" + struct.pack("<Q", 4)
VARIANTS = [
    {"compression": "zstd"},
    {"compression": "lz4"},
    {"compression": "none"},
    {"chunked": False},
]


@pytest.fixture
def written():
    return sample(IMU, 200), sample(POINT, 50)


@pytest.fixture
def path(tmp_path, written):
    """A log of about twenty chunks."""
    path = tmp_path / "x.mcap"
    write_log(path, written, chunk_size=4000)
    return path


def chunks(path):
    """The chunk indexes in the order of the file."""
    with open(path, "rb") as file:
        return sorted(make_reader(file).get_summary().chunk_indexes, key=lambda index: index.chunk_start_offset)


def without_summary(path):
    """The file as far as the end of its data section."""
    with open(path, "rb") as file:
        start = make_reader(file).get_summary().chunk_indexes[-1]
    data = path.read_bytes()
    return data[: data.index(DATA_END, start.chunk_start_offset)]


def overwrite(path, at, data):
    with open(path, "r+b") as file:
        file.seek(at)
        file.write(data)


def assert_part_of(log, written):
    """Every row of the log is a row of what was written; returns how many there are."""
    count = 0
    for series in written:
        read = log.series.get(series.topic)
        if read is not None:
            rows = np.searchsorted(series.t_ns, read.t_ns)
            assert_same(read, series.select(rows))
            count += len(rows)
    return count


# ---- chunks ----


@pytest.mark.parametrize("options", VARIANTS[:3])
def test_a_flipped_byte_costs_its_chunk_and_is_said(tmp_path, written, options):
    path = tmp_path / "x.mcap"
    write_log(path, written, chunk_size=4000, **options)
    index = chunks(path)[7]
    at = index.chunk_start_offset + index.chunk_length // 2
    overwrite(path, at, bytes([path.read_bytes()[at] ^ 0x10]))
    log = read_log(path)
    (line,) = log.damage
    found = re.match(r"x.mcap: chunk at byte (\d+) \((\d+) bytes, (\d+) messages\) skipped: (.+)", line)
    assert int(found[1]) == index.chunk_start_offset
    assert int(found[2]) == index.chunk_length - 9
    assert assert_part_of(log, written) == 250 - int(found[3])
    assert 10 <= int(found[3]) <= 20


def test_the_first_chunk_may_be_lost_with_its_declarations(path, written):
    first = chunks(path)[0]
    overwrite(path, first.chunk_start_offset + 60, bytes(40))
    log = read_log(path)
    assert assert_part_of(log, written) > 220
    assert len(log.damage) == 1


def test_the_first_chunk_lost_and_no_summary_to_replace_its_declarations(path, written):
    """Which topics the rest belongs to is then unknown; the error says why nothing is left."""
    first = chunks(path)[0]
    path.write_bytes(without_summary(path))
    overwrite(path, first.chunk_start_offset + 60, bytes(40))
    with pytest.raises(
        LogError, match=r"skipped: .*; x.mcap: 193 messages of channel 1, which is declared nowhere"
    ) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)


def test_a_wrong_record_length_costs_one_chunk(path, written):
    """The index tells where the next chunk begins."""
    index = chunks(path)[7]
    overwrite(path, index.chunk_start_offset + 1, struct.pack("<Q", 10**9))
    log = read_log(path)
    assert 230 <= assert_part_of(log, written) < 250
    assert len(log.damage) == 1
    assert "skipped to the next chunk" in log.damage[0]


def test_a_chunk_of_unknown_compression_is_named(path, written):
    index = chunks(path)[3]
    at = path.read_bytes().index(b"zstd", index.chunk_start_offset)
    overwrite(path, at, b"zzzz")
    log = read_log(path)
    assert "compression 'zzzz' is unknown" in log.damage[0]
    assert 230 <= assert_part_of(log, written) < 250


def test_every_chunk_damaged_is_an_error_that_says_so(path):
    for index in chunks(path):
        overwrite(path, index.chunk_start_offset + 60, bytes(8))
    with pytest.raises(LogError, match=r"no message could be read from \d+ bytes; x.mcap: chunk at byte"):
        read_log(path)


# ---- the end of the file ----


def test_a_file_that_was_not_closed_is_read_to_its_end(path, written):
    path.write_bytes(without_summary(path))
    log = read_log(path)
    assert assert_part_of(log, written) == 250
    (line,) = log.damage
    assert f"ends at byte {path.stat().st_size} without a footer" in line


@pytest.mark.parametrize("options", VARIANTS)
@pytest.mark.parametrize("share", [0.31, 0.5, 0.77])
def test_a_cut_file_is_read_up_to_the_cut(tmp_path, written, options, share):
    path = tmp_path / "x.mcap"
    write_log(path, written, chunk_size=4000, **options)
    whole = without_summary(path) if options.get("chunked", True) else path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    log = read_log(path)
    assert len(log.damage) == 1
    assert assert_part_of(log, written) > (share - 0.1) * 250


@pytest.mark.parametrize("options", VARIANTS[:3])
def test_of_a_cut_chunk_its_beginning_is_read(tmp_path, options):
    """A file of a single chunk would otherwise be lost to the last byte."""
    imu = sample(IMU, 5000)
    path = tmp_path / "x.mcap"
    write_log(path, [imu], chunk_size=100 << 20, **options)
    (index,) = chunks(path)
    path.write_bytes(path.read_bytes()[: index.chunk_start_offset + int(0.8 * index.chunk_length)])
    log = read_log(path)
    assert 2000 < assert_part_of(log, [imu]) < 4500
    assert "was cut at byte" in log.damage[0]
    assert "unchecked" in log.damage[0]


def test_a_legal_file_without_index_is_not_damaged(path, written):
    no_summary = DATA_END + bytes(4) + b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0) + b"\x89MCAP0\r\n"
    path.write_bytes(without_summary(path) + no_summary)
    log = read_log(path)
    assert log.damage == ()
    assert assert_part_of(log, written) == 250


def test_a_damaged_summary_is_not_used(path, written):
    at = path.read_bytes().rindex(b"/imu")
    overwrite(path, at, b"/umi")
    log = read_log(path)
    assert assert_part_of(log, written) == 250
    assert "summary" in log.damage[0]


def test_a_damaged_summary_without_a_checksum(path, written):
    data = bytearray(path.read_bytes())
    at = data.rindex(b"zstd")  # in the last chunk index, whose own length then runs over its end
    data[at - 4 : at] = struct.pack("<I", 10**6)
    data[-12:-8] = bytes(4)
    path.write_bytes(data)
    log = read_log(path)
    assert assert_part_of(log, written) == 250
    assert log.damage[0].startswith("x.mcap: an index in the summary cannot be read")


# ---- outside chunks ----


def test_a_flipped_byte_outside_chunks_is_noticed(tmp_path, written):
    """There the checksum covers the whole section: nothing can be singled out."""
    path = tmp_path / "x.mcap"
    write_log(path, written, chunked=False)
    assert read_log(path).damage == ()
    overwrite(path, path.stat().st_size // 2, b"\x99")
    log = read_log(path)
    assert sum(map(len, log.series.values())) > 200
    assert "checksum of the data section differs" in log.damage[-1]


def test_a_damaged_attachment_is_left_out(tmp_path, written):
    path = tmp_path / "x.mcap"
    write_log(path, written, attachments={"rig.yaml": b"name: shaft", "notes.txt": b"dry"})
    at = path.read_bytes().index(b"shaft")
    overwrite(path, at, b"shift")
    log = read_log(path)
    assert log.attachments == {"notes.txt": b"dry"}
    assert log.damage == ("x.mcap: attachment rig.yaml (79 bytes) skipped: checksum differs",)


# ---- not a log at all ----


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty .0 bytes"),
        (b"hello", "not an MCAP file .5 bytes, beginning with b'hello'; record with: ros2 bag record -s mcap"),
        (b"SQLite format 3\0" + bytes(100), "a rosbag2 database; convert it with: ros2 bag convert"),
        (b"#ROSBAG V2.0\n", "a ROS 1 bag; convert it with: mcap convert"),
        (b"\x28\xb5\x2f\xfd" + bytes(20), "zstd -d"),
        (b"\x89MCAP0\r\n", "no message could be read from 8 bytes; x.mcap: ends at byte 8 without a footer"),
        (b"\x89MCAP0\r\n" + bytes(1000), "1000 bytes from byte 8 to the end"),
    ],
)
def test_what_is_no_log_is_refused_in_one_line(tmp_path, content, said):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=said) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)


def test_an_absent_file_is_refused_in_one_line(tmp_path):
    with pytest.raises(LogError, match=r"absent.mcap: cannot be read \(No such file or directory\)"):
        read_log(tmp_path / "absent.mcap")


def test_a_log_without_messages_is_refused(tmp_path):
    write_log(tmp_path / "x.mcap", [])
    with pytest.raises(LogError, match="no message could be read"):
        read_log(tmp_path / "x.mcap")


# ---- wild damage ----


def read_or_refuse(path):
    """The log, or None for an error of one line; anything else fails the test."""
    line = ""
    try:
        return read_log(path)
    except LogError as error:
        line = str(error)
    assert line
    assert "\n" not in line
    return None


@pytest.mark.parametrize("options", VARIANTS[:3])
def test_no_single_wrong_byte_gives_a_wrong_number(tmp_path, options):
    written = sample(IMU, 12), sample(POINT, 9)
    path = tmp_path / "x.mcap"
    write_log(path, written, chunk_size=700, **options)
    sound = path.read_bytes()
    rng = random.Random(1)
    for at in rng.sample(range(8, len(sound)), 250):
        broken = bytearray(sound)
        broken[at] ^= 1 << rng.randrange(8)
        path.write_bytes(broken)
        log = read_or_refuse(path)
        if log:
            assert assert_part_of(log, written) == 21 or log.damage, f"byte {at}"


@settings(max_examples=120, deadline=None)
@given(drawn=st.data())
def test_any_damage_ends_in_a_log_or_in_one_line(tmp_path_factory, drawn):
    path = tmp_path_factory.getbasetemp() / "wild.mcap"
    options = drawn.draw(st.sampled_from(VARIANTS))
    write_log(path, [sample(IMU, 6), sample(POINT, 5)], chunk_size=700, attachments={"a": b"b"}, **options)
    broken = bytearray(path.read_bytes())
    for _ in range(drawn.draw(st.integers(0, 5))):
        at = drawn.draw(st.integers(0, len(broken)))
        broken[at : at + drawn.draw(st.integers(0, 40))] = drawn.draw(st.binary(max_size=40))
    path.write_bytes(broken)
    read_or_refuse(path)
