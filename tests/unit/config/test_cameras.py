import pytest

from mavbridge.config.flight import CameraConfig
from mavbridge.core.errors import UserError


@pytest.mark.parametrize(
    ("given", "cameras", "sources"),
    [
        (("0",), ("front",), ("0",)),
        (("0",), ("anything",), ("0",)),
        (("front=0",), ("front",), ("0",)),
        (("down=/dev/video2", "front=0"), ("front", "down"), ("0", "/dev/video2")),
        (("rtsp://host/live?user=a",), ("front",), ("rtsp://host/live?user=a",)),
        (("front=http://host/?a=b",), ("front",), ("http://host/?a=b",)),
        (("./a=b.mp4",), ("front",), ("./a=b.mp4",)),
        (("screen:A=B",), ("front",), ("screen:A=B",)),
        (("pipe:sh -c 'a\nb=c'",), ("front",), ("pipe:sh -c 'a\nb=c'",)),
        (("down=pipe:a\nb", "front=0"), ("front", "down"), ("0", "pipe:a\nb")),
    ],
)
def test_each_camera_of_the_policy_gets_its_source(
    given: tuple[str, ...], cameras: tuple[str, ...], sources: tuple[str, ...]
) -> None:
    assert CameraConfig(camera=given).sources_of(cameras) == sources


@pytest.mark.parametrize(
    ("given", "cameras"),
    [
        (("0",), ("front", "down")),
        (("front=0",), ("front", "down")),
        (("front=0", "up=1"), ("front", "down")),
        (("front=0", "down=1"), ("front",)),
        (("down=1",), ("front",)),
    ],
)
def test_names_that_the_policy_does_not_have_are_refused(
    given: tuple[str, ...], cameras: tuple[str, ...]
) -> None:
    wanted = " ".join(f"--camera {name}=SOURCE" for name in cameras)
    with pytest.raises(UserError, match=f"--camera {' '.join(given)}: .*give {wanted}$"):
        CameraConfig(camera=given).sources_of(cameras)


@pytest.mark.parametrize("given", [("0", "1"), ("0", "down=1"), ("a=0", "a=1")])
def test_several_cameras_have_different_names(given: tuple[str, ...]) -> None:
    with pytest.raises(UserError, match="each has a name of its own"):
        CameraConfig(camera=given)


def test_an_empty_list_of_cameras_is_refused() -> None:
    with pytest.raises(UserError, match="an empty list: name a camera"):
        CameraConfig(camera=())
