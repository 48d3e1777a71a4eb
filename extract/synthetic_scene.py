"""The scene of a synthetic pour as a MuJoCo model, and its renderer: table, wall, clutter, lamps, vessels, a hand.

MuJoCo is only the picture here: all moving parts are mocap bodies put where the path says, no physics is stepped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .geometry import Array
from .offscreen import load_mujoco
from .synthetic_hand import FOREARM, Grip, forearm_poses, hand_capsules
from .synthetic_look import vessel_look
from .synthetic_motion import Camera, PourPath
from .synthetic_textures import Image, random_color, table_texture, wall_texture

if TYPE_CHECKING:
    from .vessel_types import Vessel

# Segmentation classes, stored as geom groups so that the renderer can also show one of them alone.
SCENERY, OBJECT, RECEPTACLE, HAND = 0, 1, 2, 3
_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


class Scene:
    """A built scene: `render(k)` gives the clean picture of frame k, `labels(k)` its exact segmentation."""

    def __init__(
        self,
        rng: np.random.Generator,
        vessel: Vessel,
        receptacle: Vessel,
        path: PourPath,
        camera: Camera,
        size_px: tuple[int, int],
        grip: Grip | None,
    ) -> None:
        mujoco = load_mujoco()
        self.notes: dict[str, Any] = {}
        self._mujoco, self._path = mujoco, path
        spec = mujoco.MjSpec()
        width, height = size_px
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.shadowsize = 2048
        spec.visual.map.znear, spec.visual.map.zfar, spec.visual.map.shadowclip = 0.02, 20.0, 1.2
        spec.stat.extent, spec.stat.center = 1.0, [0.0, 0.0, 0.1]
        self._spec, self._rng = spec, rng
        self._count = 0

        self._lamps()
        self._room(camera)
        self._clutter(path)
        self._add_camera(camera)
        self._bodies: list[tuple[int, Array]] = []
        self._add_vessel("object", vessel, OBJECT)
        self._add_vessel("receptacle", receptacle, RECEPTACLE)
        moving = [path.T_world_object, np.broadcast_to(path.T_world_receptacle, path.T_world_object.shape)]
        if grip is not None:
            hand, forearm = self._add_hand(grip, path)
            moving += [hand, forearm]
        self._moving = np.stack(moving, axis=1)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)

    def close(self) -> None:
        self._renderer.close()

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def render(self, k: int) -> Image:
        """(H, W, 3) picture of frame k without noise."""
        self._pose(k)
        self._renderer.disable_segmentation_rendering()
        option = self._mujoco.MjvOption()
        option.geomgroup[:] = 1  # by default MuJoCo hides groups from 3 on
        self._renderer.update_scene(self._data, camera="camera", scene_option=option)
        return np.array(self._renderer.render())

    def labels(self, k: int, only: int | None = None) -> NDArray[np.int8]:
        """(H, W) class of every pixel of frame k: SCENERY, OBJECT, RECEPTACLE or HAND; `only` hides the others."""
        self._pose(k)
        option = self._mujoco.MjvOption()
        option.geomgroup[:] = 1 if only is None else 0
        if only is not None:
            option.geomgroup[only] = 1
        self._renderer.enable_segmentation_rendering()
        self._renderer.update_scene(self._data, camera="camera", scene_option=option)
        ids = self._renderer.render()[..., 0]
        groups = np.append(np.asarray(self._model.geom_group), SCENERY)  # id -1 (nothing hit) reads the last entry
        return np.asarray(groups[ids], np.int8)

    def visible_fraction(self, k: int) -> float:
        """Share of the object's pixels in frame k that nothing hides."""
        alone = np.count_nonzero(self.labels(k, only=OBJECT) == OBJECT)
        return float(np.count_nonzero(self.labels(k) == OBJECT) / max(alone, 1))

    def _pose(self, k: int) -> None:
        T = self._moving[k]
        self._data.mocap_pos[:] = T[:, :3, 3]
        self._data.mocap_quat[:] = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)

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

    def _room(self, camera: Camera) -> None:
        rng, world, plane = self._rng, self._spec.worldbody, self._mujoco.mjtGeom.mjGEOM_PLANE
        table_kind, table = table_texture(rng)
        wall_kind, wall = wall_texture(rng)
        tile = rng.uniform(0.35, 0.7)
        depth = rng.uniform(0.45, 0.9)
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

    def _clutter(self, path: PourPath) -> None:
        """Boxes, cans and balls at the back of the table, out of the way of the motion."""
        rng, geom = self._rng, self._mujoco.mjtGeom
        turn = Rotation.from_euler("z", self._turn)
        things = int(rng.integers(4, 9))
        self.notes["scenery"]["clutter"] = things
        for _ in range(things):
            kind = (geom.mjGEOM_BOX, geom.mjGEOM_CYLINDER, geom.mjGEOM_ELLIPSOID)[int(rng.choice(3, p=[0.6, 0.3, 0.1]))]
            half = rng.uniform([0.02, 0.02, 0.02], [0.09, 0.05, 0.13])
            if kind == geom.mjGEOM_CYLINDER:
                half[:2] = half[0] * 0.6, half[2]
            z = half[1] if kind == geom.mjGEOM_CYLINDER else half[2]
            back = self._depth - rng.uniform(0.06, 0.22)
            pos = turn.apply([rng.uniform(-0.7, 0.7), max(back, 0.25), z])
            self._spec.worldbody.add_geom(
                type=kind,
                size=half,
                pos=pos,
                quat=Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_quat(scalar_first=True),
                rgba=[*random_color(rng, (0.1, 0.8), (0.2, 0.9)), 1.0],
                group=SCENERY,
            )

    def _add_camera(self, camera: Camera) -> None:
        quat = Rotation.from_matrix(camera.T_world_camera[:3, :3] @ _OPENCV_TO_OPENGL).as_quat(scalar_first=True)
        self._spec.worldbody.add_camera(
            name="camera", pos=camera.T_world_camera[:3, 3], quat=quat, fovy=np.rad2deg(camera.fovy_rad)
        )

    def _add_vessel(self, name: str, vessel: Vessel, group: int) -> None:
        rng = self._rng
        look = vessel_look(rng, vessel)
        self.notes[f"{name}_look"] = {"print": look.kind, "color_rgb": [round(float(c), 3) for c in look.color_rgb]}
        material = self._material(look.texture, specular=rng.uniform(0.3, 0.9), shininess=rng.uniform(0.4, 0.95))
        self._spec.add_mesh(
            name=name,
            uservert=np.asarray(vessel.mesh.vertices, float).ravel(),
            userface=np.asarray(vessel.mesh.faces, np.int32).ravel(),
            usertexcoord=look.uv.ravel(),
            userfacetexcoord=look.uv_faces.ravel(),
            inertia=self._mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        body = self._spec.worldbody.add_body(name=name, mocap=True)
        body.add_geom(type=self._mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=material, group=group)

    def _add_hand(self, grip: Grip, path: PourPath) -> tuple[Array, Array]:
        """The hand moves with the vessel, the forearm leads from the wrist toward a shoulder out of view.

        Returns the poses (N, 4, 4) of both bodies.
        """
        rng, capsule = self._rng, self._mujoco.mjtGeom.mjGEOM_CAPSULE
        skin = np.array([0.92, 0.7, 0.58]) * rng.uniform(0.45, 1.05) * (1 + 0.05 * rng.uniform(-1, 1, 3))
        sleeve = random_color(rng, (0.0, 0.7), (0.15, 0.95))
        self.notes["hand"] = {"grasp": grip.grasp.kind}
        limbs = {"hand": [(*part, skin * rng.uniform(0.96, 1.04)) for part in hand_capsules(grip)]}
        limbs["forearm"] = [(*part, (skin, sleeve)[k]) for k, part in enumerate(FOREARM)]
        for name, parts in limbs.items():
            body = self._spec.worldbody.add_body(name=name, mocap=True)
            for start, end, radius, rgb in parts:
                rgba = [*np.clip(rgb, 0, 1), 1.0]
                body.add_geom(type=capsule, fromto=[*start, *end], size=[radius, 0, 0], rgba=rgba, group=HAND)
        return path.T_world_object, forearm_poses(rng, grip, path)
