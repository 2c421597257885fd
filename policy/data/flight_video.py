"""Images of a recorded flight, and their rows, complete or up to any damage.

RGB images are in H.264, depth images in FFV1, in a fragmented MP4 (ISO/IEC 14496-12): a moov box
without samples, then a moof and an mdat box for each image. Image k belongs to row k.
"""

import mmap
from collections.abc import Iterable, Iterator
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from policy.contract import CameraImage
from policy.data.flight_data import ImageArray
from policy.data.flight_files import FRAMES, of_camera, table_file, video_of
from policy.data.tables import read_table
from policy.errors import DatasetError
from policy.files import why_unreadable

_BOX_HEADER_BYTES = 8
_KINDS = (b"ftyp", b"moov", b"moof", b"mdat", b"mfra", b"free")
_MOOF_TO_NUMBER = 20
"""Offset of a moof box's sequence number, from 1."""


def read_frames(
    folder: Path,
    camera: str | None,
    schema: pa.Schema,
    *,
    optional: Iterable[pa.Field],
    recorded: int | None,
    damage: list[str],
) -> pa.Table:
    """Read the rows of a camera's images, as many as its video has; ``camera`` None: the first.

    ``recorded`` is the number of images that the flight counted at its end; None: it was cut off.
    Sentences about lost images go to ``damage``; ``schema`` and ``optional`` are as for
    ``read_table``.

    Raises:
        DatasetError: a file is missing, or holds none of the images.
    """
    stem, video = folder / of_camera(FRAMES, camera), folder / video_of(camera)
    has_table, has_video = table_file(stem).exists(), video.exists()
    if not (has_table and has_video):
        if recorded and (camera is None or has_table or has_video):
            missing = video.name if has_table else f"{stem.name}.parquet"
            raise DatasetError(
                f"{folder} lacks {missing}, though {recorded} frames were recorded: copy the "
                "folder again, whole"
            )
        return schema.empty_table()  # the flight ended before its first frame
    table = read_table(stem, schema, optional=optional, damage=damage)
    try:
        images, end = whole_images(video)
    except OSError as error:
        raise DatasetError(why_unreadable(video, error)) from error
    if recorded is not None and table.num_rows and not images:
        none = ValueError(f"it holds none of {table.num_rows} images")
        raise DatasetError(why_unreadable(video, none))
    if skipped := video.stat().st_size - end:
        damage.append(f"{video} is damaged or cut off: its last {skipped} bytes were skipped")
    if recorded is not None and images != table.num_rows:
        damage.append(f"{video}: {images} images for {table.num_rows} rows")
    return table.slice(0, images)


def whole_images(path: Path) -> tuple[int, int]:
    """Count the images before any damage, without decoding them; raises OSError.

    Returns:
        The number of images, and the offset at which the whole boxes end.
    """
    size = path.stat().st_size
    if not size:
        return 0, 0
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at, images, end, is_moof = 0, 0, 0, False
        while at < size:
            kind, after = data[at + 4 : at + 8], at + _number(data, at)
            if kind not in _KINDS or not at + _BOX_HEADER_BYTES <= after <= size:
                break
            if kind == b"moof" and _number(data, at + _MOOF_TO_NUMBER) != images + 1:
                break  # of another place
            if kind == b"mdat" and not is_moof:
                break  # of another kind of MP4
            is_moof = kind == b"moof"
            images += kind == b"mdat"
            end = end if is_moof else after
            at = after
    return images, end


def _number(data: mmap.mmap, at: int) -> int:
    return int.from_bytes(data[at : at + 4], "big")


def _decoded(path: Path, count: int) -> Iterator[CameraImage]:
    """Yield the first images; raise OSError, ValueError or av.FFmpegError if one is damaged."""
    images, end = whole_images(path)
    if images < count:
        raise ValueError(f"{count - images} of {count} images are missing")
    # Mapped up to the last whole image, since demuxers stumble over a torn box.
    with path.open("rb") as file, mmap.mmap(file.fileno(), end, access=mmap.ACCESS_READ) as data:
        with av.open(data, "r", format="mp4") as container:
            stream, converter = container.streams.video[0], VideoReformatter()
            stream.codec_context.options = {"err_detect": "explode"}
            left = count
            for image in container.decode(stream):
                yield _pixels(image, converter)
                left -= 1
                if not left:
                    return
        raise ValueError(f"{left} images are missing at its end")


def decode_images(path: Path, count: int) -> Iterator[CameraImage]:
    """Yield the first images of a flight's video, as they were recorded.

    RGB [H, W, 3] uint8, or depth [H, W] uint16.

    Raises:
        DatasetError: the data of an image is damaged.
    """
    done = 0
    try:
        for image in _decoded(path, count) if count else ():
            yield image
            done += 1
    except (av.FFmpegError, OSError, ValueError) as error:
        raise DatasetError(
            f"{why_unreadable(path, error)}; {done} of its {count} images came before the "
            "damage: use another copy, or leave this flight out"
        ) from error


def decode_video(path: Path, count: int) -> Iterator[ImageArray]:
    """Yield images as ``decode_images`` does; raise DatasetError if they are depth images."""
    for image in decode_images(path, count):
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
