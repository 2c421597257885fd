"""Images of a recorded flight: fragmented MP4 with one fragment per frame, complete or damaged.

RGB images are in H.264, depth images in FFV1. Layout: ISO/IEC 14496-12. A moov box without samples,
then a moof and an mdat box for each frame.
"""

import io
import mmap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from policy.contract import CameraImage
from policy.data.flight_data import DatasetError, ImageArray
from policy.files import why_unreadable

_BOX_HEADER_BYTES = 8
_KINDS = (b"ftyp", b"moov", b"moof", b"mdat", b"mfra", b"free")
_MOOF_TO_MFHD, _MOOF_TO_NUMBER = 12, 20
"""Offsets in a moof box: of its first child's name, and of its sequence number (from 1)."""
_SLICE, _KEY_SLICE = 1, 5
"""NAL unit types of H.264."""


class Fragment(NamedTuple):
    """A moof box and its mdat box."""

    number: int
    """Number of the image in the flight, from 0."""
    start: int
    end: int
    is_key: bool


class VideoParts(NamedTuple):
    """Decodable parts of a video."""

    head_bytes: int
    fragments: tuple[Fragment, ...]
    """After damage they continue at the next key frame."""
    skipped_bytes: int
    skipped_frames: int


def video_parts(path: Path) -> VideoParts:
    """Find the images of a video without decoding them; raises OSError."""
    size = path.stat().st_size
    if not size:
        return VideoParts(0, (), 0, 0)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        fragments, skipped, head = [], 0, 0
        is_intra = data.find(b"FFV1", 0, max(0, data.find(b"moof"))) >= 0  # depth images
        at, moof = 0, -1
        while at < size:
            kind, end = data[at + 4 : at + 8], at + int.from_bytes(data[at : at + 4], "big")
            if kind not in _KINDS or not at + _BOX_HEADER_BYTES <= end <= size:
                end, moof = _next_moof(data, at + 1), -1
                skipped += end - at
            elif kind == b"moof":
                moof, head = at, head or at
            elif kind == b"mdat":
                is_single = moof >= 0 and _number(data, data.find(b"trun", moof, at) + 8) == 1
                is_key: bool | None = None
                if is_single:
                    is_key = is_intra or _is_key(data, at + _BOX_HEADER_BYTES, end)
                if is_key is None:
                    skipped += end - max(moof, 0)
                else:
                    number = _number(data, moof + _MOOF_TO_NUMBER) - 1
                    fragments.append(Fragment(number, moof, end, is_key))
                moof = -1
            at = end
    kept = tuple(_decodable(fragments))
    return VideoParts(head, kept, skipped, len(fragments) - len(kept))


def _number(data: mmap.mmap, at: int) -> int:
    return int.from_bytes(data[at : at + 4], "big")


def with_images(
    path: Path, numbers: NDArray[np.int64], *, is_whole: bool
) -> tuple[NDArray[np.int64], list[str]]:
    """Select the rows, given by their image numbers, that have an image in the video.

    ``is_whole``: the flight ended normally, so each row had an image.

    Returns:
        Indices of the rows, and sentences about the lost images.

    Raises:
        DatasetError: the video cannot be read.
    """
    try:
        parts = video_parts(path)
    except OSError as error:
        raise DatasetError(why_unreadable(path, error)) from error
    found = [fragment.number for fragment in parts.fragments]
    places = np.flatnonzero(np.isin(numbers, found))
    damage = []
    if parts.skipped_bytes:
        damage.append(
            f"{path} is damaged or cut off: {parts.skipped_bytes} bytes and {parts.skipped_frames} "
            "whole images that need what is lost were skipped"
        )
    lost, extra = len(numbers) - len(places), len(found) - len(places)
    if is_whole and (lost or extra):
        damage.append(f"{path}: {lost} of its rows have no image, {extra} images have no row")
    return places, damage


def _next_moof(data: mmap.mmap, at: int) -> int:
    """Return the offset of the next moof box at or after ``at``, or the end of the data."""
    at += 4  # its size comes before its name
    while (found := data.find(b"moof", at)) >= 0:
        start = found - 4
        if data[start + _MOOF_TO_MFHD : start + _MOOF_TO_MFHD + 4] == b"mfhd":
            return start
        at = found + 1
    return len(data)


def _is_key(data: mmap.mmap, at: int, end: int) -> bool | None:
    """True if an image depends on no other; None if it is not H.264."""
    is_key = None
    while at + 4 < end:
        kind = data[at + 4] & 0x1F
        if kind in (_SLICE, _KEY_SLICE):
            is_key = kind == _KEY_SLICE
        at += 4 + int.from_bytes(data[at : at + 4], "big")
    return is_key if at == end else None


def _decodable(fragments: list[Fragment]) -> Iterator[Fragment]:
    """Drop the fragments from a gap to the next key frame: an image needs the one before it."""
    expected, is_broken = 0, False
    last = max((each.number for each in fragments), default=0)
    for place, fragment in enumerate(fragments):
        # A key image may come after lost ones; a damaged number would move all that follow.
        later = fragments[place + 1].number if place + 1 < len(fragments) else last + 1
        is_next = fragment.number == expected
        is_key = fragment.is_key and (is_next or expected < fragment.number < later)
        is_broken = not is_key and (is_broken or not is_next)
        if not is_broken:
            expected = fragment.number + 1
            yield fragment


def _decoded(path: Path, wanted: set[int]) -> Iterator[CameraImage]:
    """Yield the images with these numbers; raise OSError, ValueError or av.FFmpegError if the data
    of one is damaged."""
    parts = video_parts(path)
    if missing := wanted - {fragment.number for fragment in parts.fragments}:
        raise ValueError(f"{len(missing)} of {len(wanted)} images are missing")
    end = parts.fragments[-1].end
    is_whole = parts.head_bytes + sum(e.end - e.start for e in parts.fragments) == end
    # Mapped up to the last whole image, since demuxers stumble over a torn box.
    with path.open("rb") as file, mmap.mmap(file.fileno(), end, access=mmap.ACCESS_READ) as data:
        whole: mmap.mmap | io.BytesIO = data
        if not is_whole:
            pieces = [data[each.start : each.end] for each in parts.fragments]
            whole = io.BytesIO(b"".join([data[: parts.head_bytes], *pieces]))
        with av.open(whole, "r", format="mp4") as container:
            stream = container.streams.video[0]
            stream.codec_context.options = {"err_detect": "explode"}
            images = zip(parts.fragments, container.decode(stream), strict=False)
            left, converter = len(wanted), VideoReformatter()
            for fragment, image in images:
                if fragment.number in wanted:
                    yield _pixels(image, converter)
                    left -= 1
                    if not left:
                        return
        raise ValueError(f"{left} images are missing at its end")


def decode_images(path: Path, numbers: Sequence[int] | NDArray[np.int64]) -> Iterator[CameraImage]:
    """Yield the images with these ascending numbers of a flight's video, as they were recorded.

    RGB [H, W, 3] uint8, or depth [H, W] uint16.

    Raises:
        DatasetError: the data of an image is damaged.
    """
    wanted, count = set(map(int, numbers)), 0
    try:
        for image in _decoded(path, wanted) if wanted else ():
            yield image
            count += 1
    except (av.FFmpegError, OSError, ValueError) as error:
        raise DatasetError(
            f"{why_unreadable(path, error)}; {count} of its {len(wanted)} images came before the "
            "damage: use another copy, or leave this flight out"
        ) from error


def decode_video(path: Path, numbers: Sequence[int] | NDArray[np.int64]) -> Iterator[ImageArray]:
    """Yield images as ``decode_images`` does; raise DatasetError if they are depth images."""
    for image in decode_images(path, numbers):
        if image.ndim == 2:
            raise DatasetError(f"{path} holds depth: this takes RGB images")
        yield np.asarray(image, np.uint8)


def _pixels(image: av.VideoFrame, converter: VideoReformatter) -> CameraImage:
    if image.format.name.startswith("gray16"):
        return image.to_ndarray().astype(np.uint16, copy=False)
    return rgb_pixels(image, converter)


def rgb_pixels(image: av.VideoFrame, converter: VideoReformatter) -> NDArray[np.uint8]:
    """Return a decoded image as RGB [H, W, 3].

    One converter serves all images of a video: without it PyAV sets up a conversion, and starts
    its threads, for each of them.
    """
    rgb = converter.reformat(image, format="rgb24", threads=1)
    return rgb.to_ndarray().astype(np.uint8, copy=False)
