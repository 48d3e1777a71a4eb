"""What every synthetic picture is taken in: a MuJoCo model with lamps, a table and a wall, and the camera's noise.

MuJoCo is only the picture here: everything is put where it is wanted, no physics is stepped.
"""

from __future__ import annotations

from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .geometry import Array
from .offscreen import load_mujoco
from .synthetic_look import Look
from .synthetic_motion import Camera
from .synthetic_textures import Image, table_texture, wall_texture

SCENERY = 0  # the group of lamps, table and wall
_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


class Studio:
    """A room that is not built yet: `notes` tells what was drawn for it.

    wall_m: nearest and farthest place of the wall behind the origin, seen from the camera.
    """

    def __init__(
        self, rng: np.random.Generator, camera: Camera, size_px: tuple[int, int], wall_m: tuple[float, float]
    ) -> None:
        mujoco = load_mujoco()
        self.notes: dict[str, Any] = {}
        self._mujoco, self._rng, self._size_px = mujoco, rng, size_px
        spec = mujoco.MjSpec()
        width, height = size_px
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.shadowsize = 2048
        spec.visual.map.znear, spec.visual.map.zfar, spec.visual.map.shadowclip = 0.02, 20.0, 1.2
        spec.stat.extent, spec.stat.center = 1.0, [0.0, 0.0, 0.1]
        self._spec = spec
        self._count = 0
        self._lamps()
        self._room(camera, wall_m)
        self._add_camera(camera)

    def close(self) -> None:
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _build(self) -> None:
        """Compile what was added; nothing can be added afterwards."""
        self._model = self._spec.compile()
        self._data = self._mujoco.MjData(self._model)
        width, height = self._size_px
        self._renderer = self._mujoco.Renderer(self._model, height, width)
        self._place()

    def _place(self) -> None:
        """Let everything follow its body."""
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)

    def picture(self) -> Image:
        """(H, W, 3) picture without noise."""
        self._renderer.disable_segmentation_rendering()
        option = self._mujoco.MjvOption()
        option.geomgroup[:] = 1  # by default MuJoCo hides groups from 3 on
        self._renderer.update_scene(self._data, camera="camera", scene_option=option)
        return np.array(self._renderer.render())

    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) exact depth along the camera's z in m."""
        self._renderer.disable_segmentation_rendering()
        self._renderer.enable_depth_rendering()
        option = self._mujoco.MjvOption()
        option.geomgroup[:] = 1
        self._renderer.update_scene(self._data, camera="camera", scene_option=option)
        drawn = np.array(self._renderer.render(), np.float32)
        self._renderer.disable_depth_rendering()
        return drawn

    def _lamps(self) -> None:
        rng, spec = self._rng, self._spec
        ambient = rng.uniform(0.3, 0.42)
        spec.visual.headlight.ambient = [ambient] * 3
        spec.visual.headlight.diffuse = [rng.uniform(0.05, 0.18)] * 3
        spec.visual.headlight.specular = [0.1] * 3
        for k in range(2):
            azimuth, elevation = rng.uniform(-0.95 * np.pi, -0.05 * np.pi), np.deg2rad(rng.uniform(35, 70))
            toward = np.array(
                [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
            )
            strength = (rng.uniform(0.4, 0.6), rng.uniform(0.1, 0.22))[k]
            tint = 1 + np.array([1, 0, -1]) * rng.uniform(-0.08, 0.12)
            spec.worldbody.add_light(
                pos=1.2 * toward,
                dir=-toward,
                type=self._mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                castshadow=k == 0,
                diffuse=np.clip(strength * tint, 0, 1),
                specular=[0.6 * strength] * 3,
                ambient=[0.0] * 3,
            )

    def _material(
        self, image: Image, repeat: tuple[float, float] = (1.0, 1.0), uniform: bool = False, **looks: float
    ) -> str:
        self._count += 1
        name = f"m{self._count}"
        texture = self._spec.add_texture(
            name=name,
            type=self._mujoco.mjtTexture.mjTEXTURE_2D,
            width=image.shape[1],
            height=image.shape[0],
            nchannel=3,
        )
        texture.data = image.tobytes()
        material = self._spec.add_material(name=name, texrepeat=repeat, texuniform=uniform, **looks)
        material.textures[int(self._mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
        return name

    def _room(self, camera: Camera, wall_m: tuple[float, float]) -> None:
        rng, world, plane = self._rng, self._spec.worldbody, self._mujoco.mjtGeom.mjGEOM_PLANE
        table_kind, table = table_texture(rng)
        wall_kind, wall = wall_texture(rng)
        tile = rng.uniform(0.35, 0.7)
        depth = rng.uniform(*wall_m)
        turn = rng.uniform(-0.15, 0.15) + camera.azimuth_rad
        self.notes["scenery"] = {"table": table_kind, "wall": wall_kind}
        shiny = self._material(
            table, (1 / tile, 1 / tile), True, specular=rng.uniform(0, 0.4), shininess=rng.uniform(0.2, 0.8)
        )
        spin = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_quat(scalar_first=True)
        world.add_geom(type=plane, size=[4, 4, 1], quat=spin, material=shiny, group=SCENERY)
        tile = rng.uniform(0.5, 1.1)
        # A plane's normal is +z: stand it up, then face the camera.
        upright = Rotation.from_euler("z", turn) * Rotation.from_euler("x", np.pi / 2)
        behind = Rotation.from_euler("z", turn).apply([0.0, depth, 0.0])
        world.add_geom(
            type=plane,
            size=[6, 4, 1],
            pos=behind,
            quat=upright.as_quat(scalar_first=True),
            material=self._material(wall, (1 / tile, 1 / tile), True, specular=0.05, shininess=0.1),
            group=SCENERY,
        )
        self._depth, self._turn = depth, turn

    def _add_camera(self, camera: Camera) -> None:
        T = camera.T_world_camera
        self._spec.worldbody.add_camera(
            name="camera", pos=T[:3, 3], quat=_camera_quat(T), fovy=np.rad2deg(camera.fovy_rad)
        )

    def _move_camera(self, T_world_camera: Array) -> None:
        """Put the built room's camera elsewhere; seen after `_place`."""
        self._model.cam_pos[0] = T_world_camera[:3, 3]
        self._model.cam_quat[0] = _camera_quat(T_world_camera)

    def _add_mesh(self, name: str, mesh: Any, look: Look, T_world_mesh: Array | None, group: int) -> None:
        """A mesh with its look; without a pose it can be moved (mocap)."""
        rng = self._rng
        material = self._material(look.texture, specular=rng.uniform(0.3, 0.9), shininess=rng.uniform(0.4, 0.95))
        self._spec.add_mesh(
            name=name,
            uservert=np.asarray(mesh.vertices, float).ravel(),
            userface=np.asarray(mesh.faces, np.int32).ravel(),
            usertexcoord=look.uv.ravel(),
            userfacetexcoord=look.uv_faces.ravel(),
            inertia=self._mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        if T_world_mesh is None:
            body = self._spec.worldbody.add_body(name=name, mocap=True)
        else:
            quat = Rotation.from_matrix(T_world_mesh[:3, :3]).as_quat(scalar_first=True)
            body = self._spec.worldbody.add_body(name=name, pos=T_world_mesh[:3, 3], quat=quat)
        body.add_geom(type=self._mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=material, group=group)


def _camera_quat(T_world_camera: Array) -> Array:
    """(4,) wxyz of MuJoCo's camera axes."""
    return np.asarray(Rotation.from_matrix(T_world_camera[:3, :3] @ _OPENCV_TO_OPENGL).as_quat(scalar_first=True))


class Sensor:
    """A small camera: lens blur, vignette, white balance, exposure flicker, shot and read noise."""

    def __init__(self, rng: np.random.Generator, size_px: tuple[int, int]) -> None:
        width, height = size_px
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        vignette = 1 - rng.uniform(0.03, 0.15) * (x * x + y * y) / 2
        balance = rng.uniform(0.94, 1.06, 3) * rng.uniform(0.95, 1.12)
        self._gain = (vignette[..., None] * balance).astype(np.float32)
        self._blur_px = rng.uniform(0.4, 0.9) * max(height / 480, 0.5)
        self._read, self._shot = rng.uniform(0.8, 1.8), rng.uniform(0.08, 0.2)
        self._flicker = rng.uniform(0.0, 0.008)

    def expose(self, picture: Image, rng: np.random.Generator) -> Image:
        """One noisy frame of a clean picture (H, W, 3)."""
        light = np.asarray(cv2.GaussianBlur(picture, (0, 0), self._blur_px), np.float32)
        light *= self._gain * np.float32(1 + self._flicker * rng.standard_normal())
        sigma = self._read + self._shot * np.sqrt(np.maximum(light, 0))
        light += sigma * rng.standard_normal(light.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(light), 0, 255), np.uint8)
