"""The pool of an experiment as a Mitsuba 3 scene, and pictures of it through the experiment's camera.

World frame: the pool frame (x ahead, y to starboard, z down, metres). Mitsuba traces all light: the water's surface is its
`dielectric` (flat, or a mesh with the normals of the waves), the rest diffuse, the sky a constant or a map. Ours are the rays
that leave the lens: pinhole and distortion are inverted by Newton's method here, and each sample of a pixel has a ray of its
own, so that no picture is resampled. Nothing of the product's optics is used.

A picture is what the lines of sight end on (16 of them a pixel, refracted and mirrored by Mitsuba) times the light there
(path-traced, with fewer pixels, smoothed: it changes slowly). Where a line of sight meets water both ways on are followed
instead of one by chance. Lamps are seen in the mirror only: what they add to the light in the water is left out.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from shoal.config.experiment import Experiment
from shoal.config.perception import Camera
from shoal.frames import Array
from shoal.messages.messages import required
from tests.localizer.photoreal.rows import RobotStates

mi.set_variant("llvm_ad_rgb")

Corners = NDArray[np.int64]

LEVELS = 400.0  # grey levels per radiance, with the sky at 1: a white plate under water comes to 200
LENS_SIGMA_PX = 0.4  # standard deviation of the lens's blur
_LIGHT_SAMPLES = 16  # paths of a pixel at which the light is traced
_LIGHT_BLUR_PX = 5.0
_QUANTILES = 1024
_CLEAR = 5  # clear surfaces that a line of sight may pass
_DEPTH = 8  # vertices of a path: plate, surface from below, floor, ...
_GRAVITY = 9.81
_MESH_M = 0.01  # spacing of the surface's mesh; between its points the slope is wrong by 5e-4 at most
_CELLS = 8  # of a plate: six of the marker and a white one on each side
_LAMP_HEIGHT_M = 2.4  # above the water
_TILE_M = 0.125
_HULL_M = 0.147  # radius; the plate lies on its top, 3 mm clear


@dataclass(frozen=True, eq=False)
class Waves:
    """A sum of plane waves: wave vectors (n, 2) rad/m, amplitudes (n,) m, phases (n,)."""

    vector: Array
    amplitude_m: Array
    phase: Array

    @classmethod
    def of(cls, kind: str, random: np.random.Generator) -> "Waves":
        """Waves of a kind: `long` ones of 5 mm, or `short` ones of 1.5 mm amplitude in all (root sum of squares)."""
        n, lengths_m, total_m = (5, (0.6, 1.4), 0.005) if kind == "long" else (9, (0.15, 0.4), 0.0015)
        angle, length = random.uniform(0.0, 2.0 * np.pi, n), random.uniform(*lengths_m, n)
        share = random.uniform(0.5, 1.0, n)
        vector = (2.0 * np.pi / length)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return cls(vector, total_m * share / np.linalg.norm(share), random.uniform(0.0, 2.0 * np.pi, n))

    def surface(self, x: Array, y: Array, t_s: float, depth_m: float) -> tuple[Array, Array, Array]:
        """Height z (down) and its slopes along x and y."""
        number = np.linalg.norm(self.vector, axis=1)
        rate = np.sqrt(_GRAVITY * number * np.tanh(number * depth_m))
        angle = np.multiply.outer(x, self.vector[:, 0]) + np.multiply.outer(y, self.vector[:, 1]) + self.phase - rate * t_s
        slope = self.amplitude_m * np.cos(angle)
        return np.sin(angle) @ self.amplitude_m, slope @ self.vector[:, 0], slope @ self.vector[:, 1]


@dataclass(frozen=True, eq=False)
class Situation:
    """All that is in the pool at one instant."""

    robots: RobotStates
    plates: tuple[str | int, ...]  # for each robot its marker, or `white` or `dark`
    time_s: float = 0.0
    waves: Waves | None = None
    bubbles_m: Array = field(default_factory=lambda: np.zeros((0, 4)))  # (n, 4): centre and radius
    tethers_m: tuple[Array, ...] = ()  # each (n, 3): points in the body frame of the robot
    drops_m: tuple[Array, ...] = ()  # for each robot (n, 3): places on the plate, radius
    low_sun_rad: float | None = None  # azimuth; None: an overcast sky


def lens_slopes(camera: Camera, column: Any, row: Any) -> tuple[Any, Any]:
    """Right and down per ahead of pixels (Dr.Jit arrays): the inverse of the distortion polynomial by Newton's method."""
    k1, k2, p1, p2, k3 = camera.distortion
    assert p1 == p2 == 0.0, "tangential distortion is not rendered"
    right = (column - camera.centre_px[0]) / camera.focal_px[0]
    down = (row - camera.centre_px[1]) / camera.focal_px[1]
    reach = dr.sqrt(right * right + down * down)
    r = mi.Float(reach)
    for _ in range(6):
        q = r * r
        r -= (r * (1 + q * (k1 + q * (k2 + q * k3))) - reach) / (1 + q * (3 * k1 + q * (5 * k2 + q * 7 * k3)))
    grow = dr.select(reach > 1e-6, r / reach, 1.0)
    return grow * right, grow * down


def _pixel_filter() -> Array:
    """Quantiles of a sample's offset from its pixel's middle, px: the pixel's width and the lens's blur together."""
    offset = np.linspace(-2.5, 2.5, 4001)
    below = sum(norm.cdf(offset, place, LENS_SIGMA_PX) for place in np.linspace(-0.5, 0.5, 101)) / 101.0
    return np.interp((np.arange(_QUANTILES) + 0.5) / _QUANTILES, below, offset)


class Studio:
    """The scene's fixed parts, and pictures of situations in it."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment, self._camera = experiment, experiment.camera
        self._turn = Rotation.from_rotvec(experiment.camera.rotation_rad)  # pool to camera
        self._integrator = mi.load_dict({"type": "path", "max_depth": _DEPTH, "rr_depth": _DEPTH})
        random = np.random.default_rng(3)
        self._fixed = self._basin(random)
        self._hull = _diffuse(_hull_picture(random))
        self._leg = _grey(0.06)
        self._plates: dict[str | int, Any] = {"white": _grey(0.85), "dark": _grey(0.04)}
        self._filter = mi.Float(_pixel_filter().astype(np.float32))
        self._calls = 0

    def render(
        self, situation: Situation, corners_px: Corners, size_px: tuple[int, int], samples: int, light: Array, mirror: Any
    ) -> NDArray[np.float64]:
        """Raw Bayer pictures (n, height, width) in grey levels, not clipped, of rectangles whose upper left pixels (even) are
        `corners_px` (n, 2), in the light of `illumination`. `mirror`: the lamps that the water mirrors."""
        scene, rays = mi.load_dict(self._scene(situation)), self._rays(corners_px, size_px, samples, 1)
        clear = _CLEAR if len(situation.bubbles_m) or situation.drops_m else 1
        radiance, sky = self._surfaces(scene, rays, mirror, clear)
        dr.eval(radiance, sky)
        colours, shine = (_means(values, samples, (len(corners_px), *size_px[::-1])) for values in (radiance, sky))
        picture = LEVELS * (colours * light + shine)
        raw = picture[..., 1].copy()  # RGGB
        raw[:, 0::2, 0::2], raw[:, 1::2, 1::2] = picture[:, 0::2, 0::2, 0], picture[:, 1::2, 1::2, 2]
        return np.asarray(raw)

    def illumination(self, situation: Situation, corners_px: Corners, size_px: tuple[int, int], stride: int) -> Array:
        """The light on what is seen in rectangles, (n, height, width, 3): traced at every `stride`-th pixel, divided by the
        surfaces' colours and smoothed. So a picture's noise is that of its edges only, as its light changes slowly."""
        scene, small = mi.load_dict(self._scene(situation)), (size_px[0] // stride, size_px[1] // stride)
        rays = self._rays(corners_px, small, _LIGHT_SAMPLES, stride)
        shape = (len(corners_px), *small[::-1])
        (radiance, _), paths = self._surfaces(scene, rays, None, 1), self._paths(scene, rays)
        dr.eval(radiance, paths)
        colours, paths = (_means(values, _LIGHT_SAMPLES, shape) for values in (radiance, paths))
        smooth = [[cv2.GaussianBlur(p, (0, 0), _LIGHT_BLUR_PX / stride) for p in pictures] for pictures in (paths, colours)]
        return np.array([cv2.resize(p / c, size_px) for p, c in zip(*smooth, strict=True)])

    def _rays(self, corners_px: Corners, size_px: tuple[int, int], samples: int, stride: int) -> Any:
        """Rays from the lens through the pixels of rectangles; each pixel's samples are neighbours."""
        self._calls += 1
        width, height = size_px
        index = dr.arange(mi.UInt32, len(corners_px) * width * height * samples)
        pixel, k = index // samples, mi.Float(index % samples)
        place = []
        step = (0.7548776662, 0.5698402910)  # of Roberts' R2 sequence
        for axis, number in enumerate(((pixel % width), (pixel // width) % height)):
            corner = dr.gather(mi.Float, mi.Float(corners_px[:, axis].astype(np.float32)), pixel // (width * height))
            seed = dr.opaque(mi.UInt32, 2 * self._calls + axis)  # a number would be compiled into the kernel, each time anew
            share = k * step[axis] + mi.sample_tea_float32(pixel, seed)
            share = mi.UInt32((share - dr.floor(share)) * _QUANTILES)
            place.append(corner + mi.Float(number * stride) + dr.gather(mi.Float, self._filter, share))
        right, down = lens_slopes(self._camera, *place)
        turn = self._turn.inv().as_matrix().astype(np.float32)
        ahead = mi.Vector3f(*(float(r[0]) * right + float(r[1]) * down + float(r[2]) for r in turn))
        return mi.Ray3f(mi.Point3f(*self._camera.position_m), dr.normalize(ahead))

    def _surfaces(self, scene: Any, rays: Any, mirror: Any, clear_surfaces: int) -> tuple[Any, Any]:
        """Along each ray the colour of the diffuse surface that it ends on, weakened by the water's surface, and the light
        of sky and lamps that comes mirrored or through bubbles."""
        hit = scene.ray_intersect(rays)
        water = self._is_water(hit)
        share = mi.fresnel(mi.Frame3f.cos_theta(hit.wi), self._camera.water_index)[0]
        glossy = water | (hit.is_valid() & (hit.p.z < -0.005))  # a surfaced plate is wet
        above = mi.Color3f(1.0)
        if mirror is not None:
            ray = hit.spawn_ray(hit.to_world(mi.reflect(hit.wi)))
            lamp = mirror.ray_intersect(ray, active=glossy)
            above = dr.select(lamp.is_valid(), lamp.emitter(mirror).eval(lamp), above)
        shine = dr.select(glossy, share * above, 0.0)
        weight, ray = mi.Color3f(1.0), mi.Ray3f(rays)
        for _ in range(clear_surfaces):  # through water, bubbles and drops
            clear = self._is_water(hit)
            onward, passed = hit.bsdf(ray).sample(mi.BSDFContext(), hit, mi.Float(1.0), mi.Point2f(0.5), clear)
            lost = mi.fresnel(mi.Frame3f.cos_theta(hit.wi), onward.eta)[0]
            weight = dr.select(clear, weight * passed * dr.select(lost < 1.0, 1.0 - lost, 1.0), weight)
            ray = dr.select(clear, hit.spawn_ray(hit.to_world(onward.wo)), ray)
            hit = dr.select(clear, scene.ray_intersect(ray, active=clear), hit)
        colour = hit.bsdf(ray).eval_diffuse_reflectance(hit, hit.is_valid())
        return dr.select(hit.is_valid(), weight * colour, 0.0), shine + dr.select(hit.is_valid(), 0.0, weight)

    def _paths(self, scene: Any, rays: Any) -> Any:
        """Radiance along the rays by Mitsuba's path tracer, without what the water mirrors."""
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self._calls, dr.width(rays))
        hit = scene.ray_intersect(rays)
        water = self._is_water(hit)
        share = mi.fresnel(mi.Frame3f.cos_theta(hit.wi), self._camera.water_index)[0]
        onward, passed = hit.bsdf(rays).sample(mi.BSDFContext(), hit, mi.Float(1.0), mi.Point2f(0.5), water)
        ray = dr.select(water, hit.spawn_ray(hit.to_world(onward.wo)), rays)
        light = self._integrator.sample(scene, sampler, mi.RayDifferential3f(ray))[0]
        return dr.select(water, (1.0 - share) * passed * light, light)

    def _is_water(self, hit: Any) -> Any:
        return hit.is_valid() & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)

    def _scene(self, situation: Situation) -> dict[str, Any]:
        scene: dict[str, Any] = {"type": "scene", **self._fixed, "sky": _sky(situation.low_sun_rad)}
        scene["water"] = self._water(situation)
        for i, plate in enumerate(situation.plates):
            scene |= self._robot(i, situation, plate)
        for k, (x, y, z, radius) in enumerate(situation.bubbles_m.tolist()):
            air = {"type": "dielectric", "int_ior": 1.0, "ext_ior": self._camera.water_index}
            scene[f"bubble{k}"] = {"type": "sphere", "center": [x, y, z], "radius": radius, "bsdf": air}
        return scene

    def _robot(self, i: int, situation: Situation, plate: str | int) -> dict[str, Any]:
        place, attitude = situation.robots.place_m[i], situation.robots.attitude_rad[i]
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZYX", attitude[::-1]).as_matrix()
        pose[:3, 3] = place
        body = mi.ScalarTransform4f(pose)
        marker = self._experiment.vehicle.marker
        half = marker.side_m * _CELLS / 12.0
        parts: dict[str, Any] = {
            f"hull{i}": {
                "type": "sphere", "to_world": body @ mi.ScalarTransform4f().scale(_HULL_M), "bsdf": self._hull,
            },
            f"plate{i}": {  # seen from above: the picture's upper edge ahead (x), its right edge to starboard (y)
                "type": "rectangle", "bsdf": self._plate(plate),
                "to_world": body @ mi.ScalarTransform4f(
                    np.array([[0, half, 0, 0], [half, 0, 0, 0], [0, 0, -1, -marker.height_m], [0, 0, 0, 1.0]])
                ),
            },
        }  # fmt: skip
        for k, (x, y) in enumerate(required(self._experiment.vehicle.legs).position_m):
            ends = ([1.1 * x, 1.1 * y, 0.02], [1.5 * x, 1.5 * y, 0.09])
            parts[f"leg{i}_{k}"] = {
                "type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": 0.022, "to_world": body,
                "bsdf": {"type": "twosided", "bsdf": self._leg},
            }  # fmt: skip
        if situation.tethers_m:
            line = situation.tethers_m[i]
            for k, (start, end) in enumerate(pairwise(line)):
                parts[f"tether{i}_{k}"] = {
                    "type": "cylinder", "p0": start.tolist(), "p1": end.tolist(), "radius": 0.004, "to_world": body,
                    "bsdf": {"type": "twosided", "bsdf": _colour(0.75, 0.3, 0.05)},
                }  # fmt: skip
        if situation.drops_m:
            for k, (x, y, radius) in enumerate(situation.drops_m[i].tolist()):
                parts[f"drop{i}_{k}"] = {
                    "type": "sphere", "center": [x, y, -marker.height_m], "radius": radius, "to_world": body,
                    "bsdf": {"type": "dielectric", "int_ior": self._camera.water_index, "ext_ior": 1.0},
                }  # fmt: skip
        return parts

    def _plate(self, plate: str | int) -> Any:
        if plate not in self._plates:
            dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
            cells = np.pad(cv2.aruco.generateImageMarker(dictionary, int(plate), _CELLS - 2), 1, constant_values=255)
            grey = np.where(cells > 127, 0.85, 0.06)
            self._plates[plate] = _diffuse(np.repeat(grey[::-1, :, None], 3, axis=2), "nearest")  # v = 0 is its first row
        return self._plates[plate]

    def _water(self, situation: Situation) -> Any:
        length, width, depth = self._experiment.pool.size_m
        glass = {"type": "dielectric", "int_ior": self._camera.water_index, "ext_ior": 1.0}
        if situation.waves is None:
            flat = mi.ScalarTransform4f().scale([length / 2, width / 2, 1.0]).rotate([1, 0, 0], 180)  # the normal is up
            return {"type": "rectangle", "to_world": flat, "bsdf": glass}
        n, m = round(length / _MESH_M), round(width / _MESH_M)
        x, y = np.meshgrid(np.linspace(-length / 2, length / 2, n), np.linspace(-width / 2, width / 2, m))
        z, slope_x, slope_y = situation.waves.surface(x.ravel(), y.ravel(), situation.time_s, depth)
        normal = np.column_stack([slope_x, slope_y, -np.ones_like(z)])
        corner = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate(
            [np.column_stack([corner, corner + n, corner + 1]), np.column_stack([corner + 1, corner + n, corner + n + 1])]
        )
        settings = mi.Properties()
        settings["bsdf"] = mi.load_dict(glass)
        mesh = mi.Mesh("water", n * m, len(faces), has_vertex_normals=True, props=settings)
        values = mi.traverse(mesh)
        values["vertex_positions"] = np.column_stack([x.ravel(), y.ravel(), z]).ravel().astype(np.float32)
        values["vertex_normals"] = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).ravel().astype(np.float32)
        values["faces"] = faces.ravel().astype(np.uint32)
        values.update()
        return mesh

    def lamps(self, lamps: Array, radiance: float) -> Any:
        """A scene of nothing but disc-shaped lamps, whose mirror images in flat water have the centre x, y and the radius of
        `lamps` (n, 3): m."""
        lens, grow = np.array(self._camera.position_m), 1.0 - _LAMP_HEIGHT_M / self._camera.position_m[2]
        scene: dict[str, Any] = {"type": "scene"}
        for k, (x, y, radius) in enumerate(lamps.tolist()):
            centre = lens[:2] + grow * (np.array([x, y]) - lens[:2])
            disc = mi.ScalarTransform4f().translate([*centre.tolist(), -_LAMP_HEIGHT_M]).scale(grow * radius)
            light = {"type": "area", "radiance": {"type": "uniform", "value": radiance}}
            scene[f"lamp{k}"] = {"type": "disk", "to_world": disc, "emitter": light}
        return mi.load_dict(scene)

    def _basin(self, random: np.random.Generator) -> dict[str, Any]:
        length, width, depth = self._experiment.pool.size_m
        tiles = 64
        grain = 0.42 + 0.012 * random.normal(size=(tiles * 16, tiles * 16, 1))
        grain[::16] = grain[:, ::16] = 0.3  # grout
        shade = np.kron(random.normal(1.0, 0.05, (tiles, tiles)), np.ones((16, 16)))[..., None]
        tiled = np.clip(grain * shade * np.array([0.62, 0.98, 1.15]), 0.02, 0.95)
        repeat = mi.ScalarTransform3f().scale([length / _TILE_M / tiles, width / _TILE_M / tiles])
        floor = {"type": "twosided", "bsdf": _diffuse(tiled, to_uv=repeat)}
        wall = {"type": "twosided", "bsdf": _colour(0.3, 0.44, 0.52)}
        deck = {"type": "twosided", "bsdf": _colour(0.35, 0.34, 0.32)}
        place = mi.ScalarTransform4f
        parts: dict[str, Any] = {
            "floor": {
                "type": "rectangle", "bsdf": floor,
                "to_world": place().translate([0, 0, depth]).scale([length / 2, width / 2, 1]),
            }
        }  # fmt: skip
        for k, (x, y) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
            axis, half = ([0, 1, 0], [depth / 2, width / 2, 1]) if x else ([1, 0, 0], [length / 2, depth / 2, 1])
            middle = [x * length / 2, y * width / 2]
            parts[f"wall{k}"] = {
                "type": "rectangle", "bsdf": wall,
                "to_world": place().translate([*middle, depth / 2]).rotate(axis, 90).scale(half),
            }  # fmt: skip
            beyond = [middle[0] + x, middle[1] + y, 0.0]
            size = [1.0, width / 2 + 2.0, 1.0] if x else [length / 2, 1.0, 1.0]
            parts[f"deck{k}"] = {"type": "rectangle", "bsdf": deck, "to_world": place().translate(beyond).scale(size)}
        return parts


def _means(values: Any, samples: int, shape: tuple[int, ...]) -> Array:
    """Mean of each pixel's samples, (*shape, 3)."""
    return np.array([dr.block_sum(v, samples) for v in values]).T.reshape(*shape, 3).astype(np.float64) / samples


def _sky(low_sun_rad: float | None) -> dict[str, Any]:
    """An overcast sky of radiance 1, or a darker one with a low, hazy sun: 25 degrees up and 30 wide."""
    if low_sun_rad is None:
        return {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    rows, columns = 128, 256  # of the sphere around Mitsuba's y axis, turned so that y is up (-z of the pool)
    elevation = np.pi / 2 - (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    up, around = np.meshgrid(elevation, azimuth, indexing="ij")
    sun = np.radians(25.0)
    apart = np.arccos(np.clip(np.sin(up) * np.sin(sun) + np.cos(up) * np.cos(sun) * np.cos(around - np.pi), -1, 1))
    light = 0.35 + 9.0 * np.exp(-0.5 * (apart / np.radians(13.0)) ** 2)
    picture = np.stack([1.1 * light, light, 0.85 * light], axis=-1).astype(np.float32)
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], float(np.degrees(low_sun_rad))).rotate([1, 0, 0], -90)
    return {"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": turn}


def _hull_picture(random: np.random.Generator) -> Array:
    """A yellow hull with dark patches, red to port and green to starboard; columns along the azimuth."""
    picture = np.ones((64, 256, 3)) * np.array([0.75, 0.48, 0.06])
    for _ in range(26):
        row, column = random.integers(0, 60), random.integers(0, 250)
        picture[row : row + random.integers(2, 9), column : column + random.integers(4, 18)] *= random.uniform(0.1, 0.7)
    picture[:, 52:76] = [0.08, 0.4, 0.12]
    picture[:, 180:204] = [0.6, 0.05, 0.05]
    return np.asarray(picture)


def _diffuse(picture: Array, filtering: str = "bilinear", to_uv: Any = None) -> Any:
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(picture.astype(np.float32)), "raw": True, "filter_type": filtering}
    if to_uv is not None:
        texture["to_uv"] = to_uv
    return mi.load_dict({"type": "diffuse", "reflectance": texture})


def _colour(red: float, green: float, blue: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [red, green, blue]}}


def _grey(level: float) -> Any:
    return mi.load_dict(_colour(level, level, level))
