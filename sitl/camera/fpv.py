"""Rendering of the view from a camera on the vehicle over a gate course, with OpenCV.

Frames: NED world; FRD body; camera x right, y down, z along the optical axis. The camera sits at
the body's origin and looks forward, tilted up, unless the conditions shift it. Pinhole, square
pixels, no distortion; integer pixel coordinates are pixel centres.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.camera import scenery
from sitl.camera.scenery import FloatArray, Image
from sitl.course import Course
from sitl.vehicle.conditions import NOMINAL, Conditions
from sitl.vehicle.rotation import Quat, Vec3, from_euler, rotate

NEAR_M = 0.05  # anything nearer or behind is clipped before projection
LOWEST_EYE_M = 0.12
"""Minimum height of the eye in the rendering, so that a vehicle on the ground sees ground."""
GLOW_SHARE = 0.18  # share of the image's width at which the sun's glow has lost 63 %
SUBPIXEL_BITS = 4  # corners are rounded to 1/16 pixel
REFERENCE_WIDTH_PX = 224  # image width that the conditions' blur refers to
NOISE_MARGIN_PX = 61
"""Margin of the noise image, which is drawn once and cropped anew for every frame."""
SMEAR_STEP_PX = 1.5
"""Motion on the optical axis between two of the images averaged for motion blur."""
MOST_SMEARED = 8  # most images averaged for motion blur
STILL: Vec3 = (0.0, 0.0, 0.0)  # the rate of a camera that does not turn

Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions:
    """Name, size and rate of published frames."""

    shm_name: str
    image_size: int  # side of the square image [pixels]
    fps: float


class FpvRenderer:
    """Draws the view from any pose on a course.

    A frame is independent of earlier frames, except for image noise.
    """

    def __init__(
        self, course: Course, width: int, height: int, conditions: Conditions = NOMINAL
    ) -> None:
        self._focal_px = width / 2 / math.tan(conditions.horizontal_fov_rad / 2)
        self._center_px = np.array([(width - 1) / 2, (height - 1) / 2])
        u_px, v_px = self._center_px
        scaled = [[1.0, 0.0, -u_px], [0.0, 1.0, -v_px], [0.0, 0.0, self._focal_px]]
        self._ray_from_pixel = np.array(scaled) / self._focal_px
        self._u_px = np.arange(width, dtype=np.float32)
        self._v_px = np.arange(height, dtype=np.float32)[:, None]
        self._body_from_camera = body_from_camera(conditions)
        self._offset_body_m = conditions.camera_offset_body_m
        self._backdrop = scenery.backdrop_colours(conditions)
        self._haze_rgb = scenery.tinted(conditions.sky_rgb[0], conditions.sky_tint)
        self._ridge_rgb = scenery.tinted(conditions.ridge_rgb, conditions.sky_tint)
        self._haze_m, self._ground_fade_m = conditions.haze_m, conditions.ground_fade_m
        self._ground = scenery.ground_tile(conditions)
        self._ridge = scenery.ridge_directions(course.seed)
        self._faces = scenery.course_faces(course, conditions)
        self._shutter = Shutter(
            conditions, u_px=self._u_px, v_px=self._v_px, focal_px=self._focal_px
        )
        self._dirt = LensDirt(conditions, width, height) if conditions.lens_drops else None
        self._sensor = _ImageSensor(conditions, width, height)
        self._glare, self._sun_ned = conditions.glare, np.array(conditions.sun_ned)

    def render(
        self, position_ned_m: Vec3, ned_from_body_wxyz: Quat, rate_body_radps: Vec3 = STILL
    ) -> Image:
        """Draw the view as [H, W, 3] uint8 RGB, a new array.

        The body rates have an effect if the conditions have an exposure or read-out time.
        """
        eye_ned_m = np.add(position_ned_m, rotate(ned_from_body_wxyz, self._offset_body_m))
        eye_ned_m[2] = min(eye_ned_m[2], -LOWEST_EYE_M)
        ned_from_camera = rotation_matrix(ned_from_body_wxyz) @ self._body_from_camera
        image = self._draw_backdrop(eye_ned_m, ned_from_camera)
        ridge = self._ridge @ ned_from_camera
        self._fill(image, ridge, np.tile(self._ridge_rgb, (len(ridge), 1)), cv2.LINE_8)
        self._draw_faces(image, eye_ned_m, ned_from_camera)
        if self._glare:
            image = self._add_glare(image, self._sun_ned @ ned_from_camera)
        image = self._shutter.expose(image, np.array(rate_body_radps) @ self._body_from_camera)
        return self._sensor.expose(self._dirt.cover(image) if self._dirt else image)

    def _draw_backdrop(self, eye_ned_m: FloatArray, ned_from_camera: FloatArray) -> Image:
        ned_ray_from_pixel = ned_from_camera @ self._ray_from_pixel
        per_u, per_v, offset = ned_ray_from_pixel[2].astype(np.float32)
        falls = per_u * self._u_px + (per_v * self._v_px + offset)
        rises = cv2.convertScaleAbs(np.clip(1 - falls, 0, 2), alpha=127.5)
        image = np.asarray(cv2.applyColorMap(rises, self._backdrop), dtype=np.uint8)
        has_ground = np.maximum(falls[:, 0], falls[:, -1]) > 0
        if has_ground.any():
            top = int(has_ground.argmax())
            pixel_from_cropped = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
            ned_ray_from_cropped = ned_ray_from_pixel @ pixel_from_cropped
            self._draw_ground(image[top:], falls[top:], eye_ned_m, ned_ray_from_cropped)
        return image

    def _draw_ground(
        self,
        image: Image,
        falls: NDArray[np.float32],
        eye_ned_m: FloatArray,
        ned_ray_from_pixel: FloatArray,
    ) -> None:
        """Blend in the ground's texture, less with distance."""
        height_m = -eye_ned_m[2]
        weight = np.maximum(falls, 0)
        weight /= weight + np.float32(height_m / self._ground_fade_m)
        weight *= weight
        # The ground point of a ray is a homography of the pixel; modulo the tile keeps it small.
        north_east_m = np.mod(eye_ned_m[:2], scenery.GROUND_TILE_M)
        tile_from_pixel = ned_ray_from_pixel.copy()
        tile_from_pixel[:2] *= height_m
        tile_from_pixel[:2] += np.outer(north_east_m, ned_ray_from_pixel[2])
        tile_from_pixel[:2] *= scenery.GROUND_TILE_PX / scenery.GROUND_TILE_M
        ground = cv2.warpPerspective(
            self._ground,
            tile_from_pixel,
            (image.shape[1], image.shape[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_WRAP,
        )
        image[:] = cv2.blendLinear(ground, image, weight, 1 - weight)

    def _draw_faces(self, image: Image, eye_ned_m: FloatArray, ned_from_camera: FloatArray) -> None:
        """Paint gates and panels from far to near, and the faces of each in their order."""
        faces = self._faces
        from_eye_m = faces.corners_ned_m - eye_ned_m
        facing = np.einsum("nk,nk->n", faces.normals_ned, from_eye_m[:, 0]) <= 0
        distance_m = np.linalg.norm(faces.centers_ned_m - eye_ned_m, axis=1)[faces.owner]
        order = np.argsort(-distance_m, kind="stable")
        order = order[facing[order]]
        haze = 1 - np.exp(-distance_m[order, None] / self._haze_m)
        rgb = faces.rgb[order] * (1 - haze) + self._haze_rgb * haze
        self._fill(image, from_eye_m[order] @ ned_from_camera, rgb, cv2.LINE_AA)

    def _add_glare(self, image: Image, sun: FloatArray) -> Image:
        """Add a glow around the sun, and a veil that grows as the sun nears the optical axis.

        ``sun`` is its direction in camera axes. Gates do not hide it.
        """
        x, y, z = sun.tolist()
        if z <= 0.0:
            return image
        white = 255.0 * self._glare
        u_px, v_px = self._center_px + self._focal_px * np.array([x, y]) / max(z, 0.05)
        away_px = np.hypot(self._u_px - np.float32(u_px), self._v_px - np.float32(v_px))
        light = white * (0.35 * z + np.exp(-away_px / (GLOW_SHARE * len(self._u_px))))
        return np.asarray(cv2.add(image, cv2.merge([light] * 3), dtype=cv2.CV_8U), dtype=np.uint8)

    def _fill(self, image: Image, corners_m: FloatArray, rgb: FloatArray, line_type: int) -> None:
        """Paint quadrilaterals [N, 4, 3], given in camera axes, in order, with colours [N, 3]."""
        seen = self._in_view(corners_m)
        corners_m = corners_m[seen]
        cut = corners_m[:, :, 2].min(axis=1) < NEAR_M
        whole_px = self._project(np.where(cut[:, None, None], 1.0, corners_m))
        colours = rgb[seen].round().astype(int).tolist()
        for index, colour in enumerate(colours):
            fixed = self._project(clip_near(corners_m[index])) if cut[index] else whole_px[index]
            cv2.fillConvexPoly(image, fixed, colour, line_type, SUBPIXEL_BITS)

    def _project(self, points_m: FloatArray) -> NDArray[np.int32]:
        """Project points to pixel coordinates [..., 2] in units of 1/16 pixel."""
        points_px = self._center_px + self._focal_px * points_m[..., :2] / points_m[..., 2:]
        return np.rint(points_px * (1 << SUBPIXEL_BITS)).astype(np.int32)

    def _in_view(self, corners_m: FloatArray) -> NDArray[np.bool_]:
        """Return the mask [N] of faces [N, 4, 3] not fully outside one side of the view frustum."""
        x, y, z = np.moveaxis(corners_m, -1, 0)
        half_width, half_height = (self._center_px + 1) / self._focal_px
        is_left, is_right = x < -half_width * z, x > half_width * z
        is_above, is_below = y < -half_height * z, y > half_height * z
        outside = np.stack([z < NEAR_M, is_left, is_right, is_above, is_below])
        return np.asarray(~outside.all(axis=2).any(axis=0))


class Shutter:
    """Motion blur and a rolling shutter that exposes rows from top to bottom.

    A frame's stamp is the middle of exposure and read-out. Only rotation counts: the camera's body
    rate alone moves the pixels of a view, independent of its content (Longuet-Higgins and Prazdny,
    "The Interpretation of a Moving Retinal Image", 1980). Motion by the vehicle's speed is left
    out: at 8 m/s, 5 m before a gate, it is 1.1 rad/s at 45 degrees from ahead.
    """

    def __init__(self, conditions: Conditions, *, u_px: Pixels, v_px: Pixels, focal_px: float):
        """Take pixel coordinates [W] and [H, 1] of an image whose middle is on the optical axis."""
        self._exposure_s, readout_s = conditions.exposure_time_s, conditions.readout_time_s
        self._u_px, self._v_px, self._focal_px = u_px, v_px, focal_px
        self._x = (u_px - u_px.mean()) / np.float32(focal_px)
        self._y = (v_px - v_px.mean()) / np.float32(focal_px)
        rows_s = np.linspace(-readout_s / 2, readout_s / 2, len(v_px), dtype=np.float32)
        self._rows_s = rows_s[:, None]
        self._is_instant = conditions.frame_time_s == 0.0

    def expose(self, image: Image, rate_camera_radps: FloatArray) -> Image:
        """Return the image [H, W, 3] of a camera that turns; may be the argument itself.

        ``rate_camera_radps`` [3] is about the camera's axes: right, down, forward. Beyond the
        image, its edge is repeated.
        """
        turn_radps = float(np.linalg.norm(rate_camera_radps))
        if self._is_instant or turn_radps == 0.0:
            return image
        flow_pxps = self.flow_pxps(rate_camera_radps)
        smear_px = turn_radps * self._exposure_s * self._focal_px
        count = min(MOST_SMEARED, 1 + math.ceil(smear_px / SMEAR_STEP_PX))
        at_s = self._exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        moved = [self._moved(image, flow_pxps, self._rows_s + np.float32(t_s)) for t_s in at_s]
        if count == 1:
            return moved[0]
        return np.asarray(np.mean(moved, axis=0).round(), dtype=np.uint8)

    def flow_pxps(self, rate_camera_radps: FloatArray) -> tuple[Pixels, Pixels]:
        """Return the flow [pixels/s], right and down, for rows exposed before or after the stamp.

        A pixel exposed t after the stamp shows the stamp's image at pixel + t * flow: the ray r =
        (x, y, 1) of a camera that has turned for t was r + t * cross(rate, r) at the stamp.
        """
        right_radps, down_radps, ahead_radps = rate_camera_radps.astype(np.float32)
        deeper = right_radps * self._y - down_radps * self._x
        flow_right = down_radps - ahead_radps * self._y - self._x * deeper
        flow_down = ahead_radps * self._x - right_radps - self._y * deeper
        focal_px = np.float32(self._focal_px)
        return focal_px * flow_right, focal_px * flow_down

    def _moved(self, image: Image, flow_pxps: tuple[Pixels, Pixels], at_s: Pixels) -> Image:
        """Return the view at times [H, 1] after the stamp."""
        flow_right, flow_down = flow_pxps
        moved = cv2.remap(
            image,
            self._u_px + at_s * flow_right,
            self._v_px + at_s * flow_down,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(moved, dtype=np.uint8)


class _ImageSensor:
    """Exposure, colour cast, blur and noise of a sensor; the n-th frame's noise is reproducible."""

    def __init__(self, conditions: Conditions, width: int, height: int) -> None:
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 3)))
        gains = conditions.exposure * np.array(conditions.white_balance)
        levels = np.arange(256)[:, None] * gains
        self._lut = np.clip(levels.round(), 0, 255).astype(np.uint8).reshape(1, 256, 3)
        self._blur_px = conditions.blur_px * width / REFERENCE_WIDTH_PX
        self._noise: NDArray[np.int16] | None = None
        if conditions.image_noise > 0.0:
            shape = (height + NOISE_MARGIN_PX, width + NOISE_MARGIN_PX, 3)
            noise = conditions.image_noise * self._random.standard_normal(shape)
            self._noise = noise.round().astype(np.int16)

    def expose(self, image: Image) -> Image:
        """Return the image [H, W, 3] RGB as recorded by the sensor."""
        image = np.asarray(cv2.LUT(image, self._lut), dtype=np.uint8)
        if self._blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self._blur_px), dtype=np.uint8)
        if self._noise is not None:
            top, left = self._random.integers(NOISE_MARGIN_PX + 1, size=2)
            height, width, _ = image.shape
            noise = self._noise[top : top + height, left : left + width]
            image = np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)
        return image


class LensDirt:
    """Drops with soft edges; each shows a blurred view, darker (dirt) or brighter (water)."""

    def __init__(self, conditions: Conditions, width: int, height: int) -> None:
        random = np.random.Generator(np.random.PCG64((conditions.seed, 10)))
        u, v = np.arange(width) / width, np.arange(height)[:, None] / width
        self._clear, self._drop = np.ones((2, height, width, 1), np.float32)
        for _ in range(round(conditions.lens_drops)):
            stretch, radius = random.uniform((0.7, 0.05), (1.4, 0.16))  # as a share of the width
            right, down = u - random.random(), v - random.random() * height / width
            away = np.hypot(right * stretch, down / stretch)[..., None] / radius
            opacity = random.uniform(0.6, 1.0) * np.clip(2.0 - 2.0 * away, 0, 1)
            self._clear *= 1.0 - opacity
            self._drop *= 1.0 + opacity * random.uniform(-0.6, 0.3)
        self._drop *= 1.0 - self._clear

    def cover(self, image: Image) -> Image:
        """Return the image [H, W, 3] as seen through the lens."""
        blurred = cv2.GaussianBlur(image, (0, 0), 0.05 * image.shape[1])
        return np.clip(self._clear * image + self._drop * blurred, 0, 255).astype(np.uint8)


def body_from_camera(conditions: Conditions = NOMINAL) -> FloatArray:
    """Return the rotation [3, 3] from camera axes (x right, y down, z forward) to FRD body axes."""
    sine, cosine = math.sin(conditions.camera_tilt_rad), math.cos(conditions.camera_tilt_rad)
    tilted = np.array([[0.0, sine, cosine], [1.0, 0.0, 0.0], [0.0, cosine, -sine]])
    about_axis = rotation_matrix(from_euler(0.0, 0.0, conditions.camera_roll_rad))
    about_down = rotation_matrix(from_euler(0.0, 0.0, conditions.camera_yaw_rad))
    return np.asarray(about_down @ tilted @ about_axis)


def clip_near(corners_m: FloatArray) -> FloatArray:
    """Clip a convex polygon [N, 3] to z >= NEAR_M (Sutherland and Hodgman, 1974)."""
    kept = []
    for start, end in zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True):
        if start[2] >= NEAR_M:
            kept.append(start)
        if (start[2] >= NEAR_M) != (end[2] >= NEAR_M):
            fraction = (NEAR_M - start[2]) / (end[2] - start[2])
            kept.append(start + fraction * (end - start))
    return np.array(kept)


def rotation_matrix(wxyz: Quat) -> FloatArray:
    """Return the rotation matrix [3, 3] of a quaternion; columns are the rotated unit vectors."""
    return np.array([rotate(wxyz, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]).T
