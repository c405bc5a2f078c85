"""Event files are read back here by a parser that shares no code with the writer; the published CRC vectors hold."""

import math
import struct

import pytest

from thorndike.training.tensorboard import EventWriter


def crc32c_bitwise(payload):
    """CRC-32C straight from its definition (RFC 3720, appendix B.4), one bit at a time."""
    register = 0xFFFFFFFF
    for bit in (byte >> position & 1 for byte in payload for position in range(8)):
        carry = (register ^ bit) & 1
        register = (register >> 1) ^ (0x82F63B78 * carry)
    return register ^ 0xFFFFFFFF


def unmask(stored):
    """The inverse of TFRecord's masking."""
    rotated = (stored - 0xA282EAD8) % 2**32
    return (rotated >> 17) | (rotated << 15) % 2**32


def records(data):
    """The payloads of a TFRecord stream, both checksums verified."""
    position = 0
    while position < len(data):
        length, length_crc = struct.unpack_from("<QI", data, position)
        payload = data[position + 12 : position + 12 + length]
        (payload_crc,) = struct.unpack_from("<I", data, position + 12 + length)
        assert unmask(length_crc) == crc32c_bitwise(data[position : position + 8])
        assert unmask(payload_crc) == crc32c_bitwise(payload)
        yield payload
        position += 16 + length


def read_varint(data, position):
    value = shift = 0
    while True:
        value |= (data[position] & 0x7F) << shift
        shift += 7
        position += 1
        if data[position - 1] < 0x80:
            return value, position


def message(data):
    """Field number -> value of a protocol buffer message, last one wins."""
    position, found = 0, {}
    while position < len(data):
        key, position = read_varint(data, position)
        kind = key & 7
        if kind == 0:
            found[key >> 3], position = read_varint(data, position)
        elif kind == 2:
            length, position = read_varint(data, position)
            found[key >> 3], position = data[position : position + length], position + length
        else:
            layout = {1: "<d", 5: "<f"}[kind]
            found[key >> 3] = struct.unpack_from(layout, data, position)[0]
            position += struct.calcsize(layout)
    return found


def scalar_of(event):
    value = message(message(event[5])[1])
    return value[1].decode(), event.get(2, 0), value[2]


def test_the_independent_checksum_is_crc32c():
    assert crc32c_bitwise(b"123456789") == 0xE3069283
    assert crc32c_bitwise(bytes(32)) == 0x8A9136AA


def test_scalars_come_back_as_written(tmp_path):
    writer = EventWriter(tmp_path / "run")
    points = [("rollout/ep_rew_mean", 475.25, 0), ("train/größe", -0.5, 127), ("x", 1e30, 128), ("time/fps", 3.0, 2**40)]
    for point in points:
        writer.scalar(point[0], point[1], point[2])
    writer.close()
    first, *rest = map(message, records(writer.path.read_bytes()))
    assert first[3] == b"brain.Event:2"
    assert [scalar_of(event) for event in rest] == [(tag, step, pytest.approx(value, rel=1e-7)) for tag, value, step in points]
    times = [event[1] for event in [first, *rest]]
    assert times == sorted(times)


def test_values_that_are_no_numbers_are_kept(tmp_path):
    writer = EventWriter(tmp_path)
    writer.scalar("loss", float("nan"), 1)
    writer.scalar("loss", float("inf"), 2)
    writer.scalar("loss", -1e39, 3)
    writer.close()
    _, nan, infinite, too_large = map(message, records(writer.path.read_bytes()))
    assert math.isnan(scalar_of(nan)[2])
    assert scalar_of(infinite)[2] == math.inf
    assert scalar_of(too_large)[2] == -math.inf


def test_a_flushed_file_can_be_read_while_it_is_open(tmp_path):
    writer = EventWriter(tmp_path)
    writer.scalar("a", 1.0, 1)
    writer.flush()
    assert len(list(records(writer.path.read_bytes()))) == 2
    writer.close()


def test_two_writers_never_share_a_file(tmp_path):
    first, second = EventWriter(tmp_path), EventWriter(tmp_path)
    first.close()
    second.close()
    assert first.path != second.path
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 2
