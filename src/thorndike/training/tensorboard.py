"""TensorBoard event files, written by hand: the format is two nested records, and its packages cost 0.2-1 s of import.

An event file is a TFRecord stream (length, checksum, payload, checksum) of `Event` protocol buffers; only scalars are written here.
Sources: tensorflow/core/lib/io/record_writer.h, tensorflow/core/util/event.proto, tensorflow/core/framework/summary.proto.
"""

import math
import os
import struct
import time
from pathlib import Path

_FLOAT32_MAX = (2 - 2**-23) * 2.0**127


class EventWriter:
    """Appends scalars to a new event file in a directory: ``scalar(tag, value, step)``, then ``close()``."""

    def __init__(self, directory: Path) -> None:
        """Make `directory` if it is missing and start ``events.out.tfevents.<seconds>.thorndike.<process>`` in it.

        A resumed run starts a further file; TensorBoard shows the files of a directory as one.
        """
        directory.mkdir(parents=True, exist_ok=True)
        self.path = directory / f"events.out.tfevents.{time.time_ns()}.thorndike.{os.getpid()}"
        self._file = self.path.open("wb")
        self._write(_text(3, "brain.Event:2"))

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Write one point of the curve `tag`; `value` is kept as float32, infinite where that is too small for it."""
        if abs(value) > _FLOAT32_MAX:
            value = math.copysign(math.inf, value)
        summary_value = _text(1, tag) + struct.pack("<Bf", 2 << 3 | 5, value)
        self._write(_integer(2, step) + _bytes(5, _bytes(1, summary_value)))

    def flush(self) -> None:
        """Hand what was written to the operating system, so that a running TensorBoard sees it."""
        self._file.flush()

    def close(self) -> None:
        """Finish the file."""
        self._file.close()

    def _write(self, fields: bytes) -> None:
        payload = struct.pack("<Bd", 1 << 3 | 1, time.time()) + fields
        length = struct.pack("<Q", len(payload))
        self._file.write(length + _checksum(length) + payload + _checksum(payload))


def _varint(number: int) -> bytes:
    """Base-128 with the low group first; a negative number counts as 64-bit two's complement."""
    number &= 0xFFFF_FFFF_FFFF_FFFF
    groups = bytearray()
    while number > 0x7F:
        groups.append(number & 0x7F | 0x80)
        number >>= 7
    groups.append(number)
    return bytes(groups)


def _integer(field: int, number: int) -> bytes:
    return _varint(field << 3) + _varint(number)


def _bytes(field: int, payload: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(payload)) + payload


def _text(field: int, text: str) -> bytes:
    return _bytes(field, text.encode())


def _crc32c_table() -> tuple[int, ...]:
    table = []
    for remainder in range(256):
        for _ in range(8):
            remainder = remainder >> 1 ^ (0x82F63B78 if remainder & 1 else 0)
        table.append(remainder)
    return tuple(table)


_TABLE = _crc32c_table()


def _checksum(payload: bytes) -> bytes:
    """CRC-32C, rotated by 15 bits and shifted by a constant, as TFRecord stores it."""
    crc = 0xFFFF_FFFF
    for byte in payload:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    crc ^= 0xFFFF_FFFF
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFF_FFFF)
