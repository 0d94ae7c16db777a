"""Frames: what goes out comes back, what is damaged is refused, a stream finds its frames again."""

import math
import re
import struct
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.plants.link.frames import (
    MAGIC,
    MOST_NUMBERS,
    SEQUENCE_RANGE,
    BadFrame,
    Frame,
    FrameStream,
    Kind,
    RigStatus,
    all_finite,
    decode,
    is_newer,
)

PAGE = Path(__file__).resolve().parents[2] / "docs" / "rig-frames.md"
words_of_32_bits = st.integers(0, 2**32 - 1)
frames = st.builds(
    Frame,
    kind=st.sampled_from(Kind).map(int),
    sequence=words_of_32_bits,
    session=words_of_32_bits,
    time=st.integers(0, 2**64 - 1),
    applied=words_of_32_bits,
    status=st.integers(0, 15),
    numbers=st.lists(st.floats(width=32, allow_nan=False), max_size=MOST_NUMBERS).map(tuple),
)


@given(frames)
def test_what_is_encoded_is_decoded(frame):
    data = frame.encode()
    assert len(data) == 36 + 4 * len(frame.numbers)
    assert decode(data) == frame


@given(frames)
def test_its_bytes_lie_where_the_contract_says(frame):
    data = frame.encode()
    assert data[:4] == b"TRMS" and data[4] == 1 and data[5] == frame.kind
    assert struct.unpack_from("<HII", data, 6) == (
        len(frame.numbers),
        frame.sequence,
        frame.session,
    )
    assert struct.unpack_from("<QII", data, 16) == (frame.time, frame.applied, frame.status)
    assert struct.unpack_from(f"<{len(frame.numbers)}f", data, 32) == frame.numbers
    assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(data[:-4])


@given(frames, st.data())
def test_one_wrong_bit_is_refused(frame, data):
    encoded = bytearray(frame.encode())
    bit = data.draw(st.integers(0, 8 * len(encoded) - 1))
    encoded[bit // 8] ^= 1 << bit % 8
    with pytest.raises(BadFrame):
        decode(bytes(encoded))


@given(frames, st.data())
def test_a_frame_that_is_cut_off_or_goes_on_is_refused(frame, data):
    encoded = frame.encode()
    cut = data.draw(st.integers(0, len(encoded) - 1))
    more = data.draw(st.binary(min_size=1, max_size=9))
    for other in (encoded[:cut], encoded + more):
        with pytest.raises(BadFrame):
            decode(other)


def test_another_version_is_told_from_garbage():
    encoded = bytearray(Frame(Kind.READ, 1, 2).encode())
    encoded[4] = 2
    with pytest.raises(BadFrame, match="version 2, this program speaks version 1"):
        decode(bytes(encoded))
    with pytest.raises(BadFrame, match="no frame"):
        decode(b"GET / HTTP/1.1\r\n" * 3)


garbage = st.binary(max_size=60).filter(lambda data: MAGIC not in data)


@given(st.lists(st.tuples(garbage, frames), max_size=6), garbage, st.data())
def test_a_stream_gives_every_whole_frame_whatever_stands_between(parts, end, data):
    stream = b"".join(noise + frame.encode() for noise, frame in parts) + end
    reader, got, rest = FrameStream(), [], stream
    while rest:
        size = data.draw(st.integers(1, len(rest)))
        got += [decode(encoded) for encoded in reader.feed(rest[:size])]
        rest = rest[size:]
    # noise that ends as a frame begins (TRM) takes nothing from the frame that follows
    assert got == [frame for _, frame in parts]
    assert reader.lost_bytes >= sum(len(noise) for noise, _ in parts)


@given(st.lists(frames, min_size=3, max_size=6), st.data())
def test_a_stream_finds_the_next_frame_after_lost_bytes(sent, data):
    """A frame that lost bytes may take those with it that its length reaches into, not more."""
    hurt = data.draw(st.integers(0, len(sent) - 2))
    encoded = [frame.encode() for frame in sent]
    begin = data.draw(st.integers(0, len(encoded[hurt]) - 1))
    count = data.draw(st.integers(1, len(encoded[hurt]) - begin))
    encoded[hurt] = encoded[hurt][:begin] + encoded[hurt][begin + count :]
    # what follows is long enough for the lost length to run out
    filler = [Frame(Kind.READ, k, 9).encode() for k in range(10)]
    reader = FrameStream()
    got = [decode(frame) for frame in reader.feed(b"".join([*encoded, *filler]))]
    expected = [frame for i, frame in enumerate(sent) if i != hurt]
    assert got[: len(expected)] == expected
    assert len(got) == len(expected) + len(filler)


@given(st.lists(frames, min_size=1, max_size=4), st.data())
def test_a_spoilt_byte_costs_its_frame_alone(sent, data):
    hurt = data.draw(st.integers(0, len(sent) - 1))
    encoded = [bytearray(frame.encode()) for frame in sent]
    place = data.draw(st.integers(0, len(encoded[hurt]) - 1))
    encoded[hurt][place] ^= data.draw(st.integers(1, 255))
    filler = [Frame(Kind.READ, k, 9).encode() for k in range(10)]
    stream = b"".join([*map(bytes, encoded), *filler])
    got = [decode(frame) for frame in FrameStream().feed(stream)]
    expected = [frame for i, frame in enumerate(sent) if i != hurt]
    assert got[: len(expected)] == expected and len(got) == len(expected) + len(filler)


def test_a_stream_of_garbage_is_not_kept():
    reader = FrameStream()
    for _ in range(100):
        assert not list(reader.feed(b"\x00TRM" * 50))
    assert len(reader._buffer) < 4 and reader.lost_bytes >= 100 * 200 - 3


@given(words_of_32_bits, st.integers(1, SEQUENCE_RANGE // 2 - 1))
def test_newer_goes_round(sequence, step):
    later = (sequence + step) % SEQUENCE_RANGE
    assert is_newer(later, sequence) and not is_newer(sequence, later)
    assert not is_newer(sequence, sequence)


def test_what_is_finite():
    assert all_finite((0.0, -1e30)) and all_finite(())
    assert not all_finite((0.0, math.inf)) and not all_finite((math.nan,))


def test_the_worked_example_of_the_page_is_a_frame():
    text = PAGE.read_text(encoding="utf-8")
    examples = re.findall(r"^```text frame\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(examples) == 2
    command, reading = (
        bytes.fromhex("".join(re.findall(r"^((?:[0-9a-f]{2} ?)+)", example, re.MULTILINE)))
        for example in examples
    )
    assert command == Frame(Kind.COMMAND, 258, 0x1BADB002, 1_000_000, numbers=(1.25, -0.5)).encode()
    numbers = (-0.5, 0.25, 100.0, -50.0)
    assert (
        reading
        == Frame(Kind.READING, 259, 0x1BADB002, 5_020_000, 258, RigStatus.ARMED, numbers).encode()
    )


def test_the_page_names_every_kind_and_bit_with_its_number():
    text = PAGE.read_text(encoding="utf-8")
    for kind in Kind:
        assert re.search(rf"^\| {kind.value} \| {kind.name} \|", text, re.MULTILINE), kind
    for state in RigStatus:
        assert re.search(rf"^\| {state.value} \| {state.name} \|", text, re.MULTILINE), state
