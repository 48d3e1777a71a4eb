"""Cluttered table tops as pictures with exact truth: things at rest, close together, seen by one camera.

Nothing overlaps: each thing rests as it would after a fall or stands upright, and outlines on the table are kept apart.
The picture is MuJoCo's; depth and masks are `extract.raster`'s of the very same meshes and poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from .bop_write import Frame, Instance
from .geometry import Array, invert_pose, look_at, make_pose, project, transform_points
from .offscreen import load_mujoco
from .protocols import Mask
from .raster import render_depth
from .synthetic_look import Look
from .synthetic_motion import Camera
from .synthetic_studio import SCENERY, Sensor, Studio

GAP_M = 0.004  # between the outlines of two things on the table
_UPRIGHT_SHARE = 0.7
_ENOUGH_VISIBLE = 0.25
_CAMERA_TRIES = 8
_MARGIN = 0.03  # of the picture's sides


@dataclass(frozen=True)
class Thing:
    """Something to put on the table: its mesh (trimesh.Trimesh, m) and look. stands: whether it has a right way up."""

    obj_id: int
    mesh: Any
    look: Look
    stands: bool


def photograph(
    rng: np.random.Generator, things: Sequence[Thing], size_px: tuple[int, int], im_id: int = 0
) -> tuple[Frame, dict[str, Any]]:
    """Put things on a table and take their picture. Returns it with its truth, and notes on the scenery.

    The camera matrix counts pixel centres as integers, so `extract.raster` draws right over the picture.
    """
    poses = place(rng, things)
    camera, drawn = _choose_camera(rng, things, poses, size_px)
    sensor = Sensor(rng, size_px)
    with _Table(rng, things, poses, camera, size_px) as table:
        picture, notes = table.picture(), table.notes
    T_camera_world = invert_pose(camera.T_world_camera)
    instances = tuple(
        Instance(thing.obj_id, T_camera_world @ T, drawn.whole[k], drawn.nearest == k)
        for k, (thing, T) in enumerate(zip(things, poses, strict=True))
    )
    rgb = sensor.expose(picture, rng)
    return Frame(im_id, rgb, drawn.depth_m, camera.camera_matrix, instances), notes


def place(rng: np.random.Generator, things: Sequence[Thing]) -> list[Array]:
    """Poses T_world_object (4, 4) at rest on z = 0, as close together as they come to lie, without overlap."""
    outlines: list[Array] = []
    poses = []
    for thing in things:
        R = _at_rest(rng, thing)
        vertices = np.asarray(thing.mesh.vertices, float) @ R.T
        flat = vertices[:, :2]
        outline = flat[ConvexHull(flat).vertices]
        spread_m = 0.02
        while True:
            offset = rng.normal(0.0, spread_m, 2)
            if all(_apart(outline + offset, other) >= GAP_M for other in outlines):
                break
            spread_m *= 1.02
        outlines.append(outline + offset)
        poses.append(make_pose(R, np.array([*offset, -vertices[:, 2].min()])))
    return poses


def _at_rest(rng: np.random.Generator, thing: Thing) -> Array:
    """A rotation (3, 3) in which a thing stays as it is."""
    turn: Array = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
    if thing.stands and rng.random() < _UPRIGHT_SHARE:
        return turn
    return np.asarray(turn @ _fallen(rng, thing.mesh))


def _fallen(rng: np.random.Generator, mesh: Any) -> Array:
    """The rotation in which a mesh lies still after a fall in a random attitude, by its convex hull."""
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.004
    rolls = {"condim": 6, "friction": [0.8, 0.02, 0.01]}  # what rolls comes to rest
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 1], **rolls)
    hull = mesh.convex_hull
    spec.add_mesh(name="it", uservert=np.ravel(hull.vertices), userface=np.asarray(hull.faces, np.int32).ravel())
    quat = Rotation.random(rng=rng).as_quat(scalar_first=True)
    body = spec.worldbody.add_body(pos=[0, 0, float(np.linalg.norm(mesh.extents)) / 2 + 0.01], quat=quat)
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="it", density=500.0, **rolls)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 750)
    return np.asarray(data.xmat[1], float).reshape(3, 3)


def _apart(a: Array, b: Array) -> float:
    """How far apart two convex polygons (A, 2), (B, 2) lie along the best separating edge; negative when none is."""
    best = -np.inf
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
        on_a, on_b = a @ normals.T, b @ normals.T
        gaps = np.maximum(on_b.min(axis=0) - on_a.max(axis=0), on_a.min(axis=0) - on_b.max(axis=0))
        best = max(best, float(gaps.max()))
    return best


@dataclass(frozen=True)
class _Drawn:
    """depth_m (H, W); whole: silhouettes (H, W) of every thing; nearest: (H, W) index of the thing in front, or -1."""

    depth_m: NDArray[np.float32]
    whole: list[Mask]
    nearest: NDArray[np.int64]

    def least_visible(self) -> float:
        """The smallest visible share of a silhouette."""
        shares = [np.count_nonzero(self.nearest == k) / max(np.count_nonzero(m), 1) for k, m in enumerate(self.whole)]
        return float(min(shares))


def _choose_camera(
    rng: np.random.Generator, things: Sequence[Thing], poses: Sequence[Array], size_px: tuple[int, int]
) -> tuple[Camera, _Drawn]:
    """Of some cameras that see everything the first in which nothing is hidden too much, or else the best."""
    best: tuple[float, Camera, _Drawn] | None = None
    for _ in range(_CAMERA_TRIES):
        camera = _camera(rng, things, poses, size_px)
        drawn = _draw(things, poses, camera, size_px)
        seen = drawn.least_visible()
        if best is None or seen > best[0]:
            best = (seen, camera, drawn)
        if seen >= _ENOUGH_VISIBLE:
            break
    assert best is not None
    return best[1], best[2]


def _camera(
    rng: np.random.Generator, things: Sequence[Thing], poses: Sequence[Array], size_px: tuple[int, int]
) -> Camera:
    width, height = size_px
    elevation, azimuth = np.deg2rad(rng.uniform(18, 55)), np.deg2rad(rng.uniform(-25, 25))
    fovy = np.deg2rad(rng.uniform(32, 48))
    focal_px = height / 2 / np.tan(fovy / 2)
    center_px = np.array([width - 1, height - 1]) / 2
    camera_matrix = np.array([[focal_px, 0.0, center_px[0]], [0.0, focal_px, center_px[1]], [0.0, 0.0, 1.0]])
    backward = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    corners = np.concatenate(
        [transform_points(T, np.asarray(t.mesh.bounding_box.vertices)) for t, T in zip(things, poses, strict=True)]
    )
    target = (corners.min(axis=0) + corners.max(axis=0)) / 2
    for distance_m in 0.35 * 1.03 ** np.arange(150):
        T = look_at(target + distance_m * backward, target, np.array([0.0, 0.0, 1.0]))
        inside = transform_points(invert_pose(T), corners)
        if inside[:, 2].min() < 0.1:
            continue
        off = np.abs(project(camera_matrix, inside) - center_px) / [width, height]
        if off.max() <= 0.5 - _MARGIN:
            break
    return Camera(T, camera_matrix, float(fovy), float(elevation), float(azimuth))


def _draw(things: Sequence[Thing], poses: Sequence[Array], camera: Camera, size_px: tuple[int, int]) -> _Drawn:
    width, height = size_px
    T_camera_world = invert_pose(camera.T_world_camera)
    depth_m = _table_depth(camera, size_px)
    nearest = np.full((height, width), -1)
    whole = []
    for k, (thing, T) in enumerate(zip(things, poses, strict=True)):
        vertices, faces = np.asarray(thing.mesh.vertices, float), np.asarray(thing.mesh.faces, np.int32)
        own = render_depth(vertices, faces, T_camera_world @ T, camera.camera_matrix)
        assert own is not None, "everything is in front of the camera and in the picture"
        here = own.depth_in_image(width, height)
        in_front = (here > 0) & ((depth_m == 0) | (here < depth_m))
        depth_m[in_front], nearest[in_front] = here[in_front], k
        whole.append(here > 0)
    return _Drawn(depth_m, whole, nearest)


def _table_depth(camera: Camera, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """(H, W) depth of the table top z = 0 in m, 0 above the horizon and beyond 3 m, where a sensor sees nothing."""
    width, height = size_px
    y, x = np.mgrid[:height, :width]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.camera_matrix).T
    down = rays @ camera.T_world_camera[2, :3]
    with np.errstate(divide="ignore"):
        depth_m = -camera.T_world_camera[2, 3] / down
    return np.where((down < 0) & (depth_m < 3.0), depth_m, 0.0).astype(np.float32)


class _Table(Studio):
    """The things in a room; `picture()` shows them."""

    def __init__(
        self,
        rng: np.random.Generator,
        things: Sequence[Thing],
        poses: Sequence[Array],
        camera: Camera,
        size_px: tuple[int, int],
    ) -> None:
        super().__init__(rng, camera, size_px, (0.6, 1.2))
        for k, (thing, T) in enumerate(zip(things, poses, strict=True)):
            self._add_mesh(f"thing{k}", thing.mesh, thing.look, T, SCENERY)
        self._build()
