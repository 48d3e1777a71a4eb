"""The scene of a synthetic pour as a MuJoCo model, and its renderer: table, wall, clutter, lamps, vessels, a hand.

MuJoCo is only the picture here: all moving parts are mocap bodies put where the path says, no physics is stepped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .geometry import Array
from .synthetic_hand import FOREARM, Grip, forearm_poses, hand_capsules
from .synthetic_look import vessel_look
from .synthetic_motion import Camera, PourPath
from .synthetic_studio import SCENERY, Studio
from .synthetic_textures import Image, random_color

if TYPE_CHECKING:
    from .vessel_types import Vessel

# Segmentation classes, stored as geom groups so that the renderer can also show one of them alone.
OBJECT, RECEPTACLE, HAND = SCENERY + 1, SCENERY + 2, SCENERY + 3


class Scene(Studio):
    """A built scene: `render(k)` gives the clean picture of frame k, `labels(k)` its exact segmentation.

    T_world_camera: (N, 4, 4) where the camera is in every frame; when None it stays where it is.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        vessel: Vessel,
        receptacle: Vessel,
        path: PourPath,
        camera: Camera,
        size_px: tuple[int, int],
        grip: Grip | None,
        T_world_camera: Array | None = None,
    ) -> None:
        super().__init__(rng, camera, size_px, (0.45, 0.9))
        self._path, self._T_world_camera = path, T_world_camera
        self._clutter(path)
        self._add_vessel("object", vessel, OBJECT)
        self._add_vessel("receptacle", receptacle, RECEPTACLE)
        moving = [path.T_world_object, np.broadcast_to(path.T_world_receptacle, path.T_world_object.shape)]
        if grip is not None:
            hand, forearm = self._add_hand(grip, path)
            moving += [hand, forearm]
        self._moving = np.stack(moving, axis=1)
        self._build()

    def render(self, k: int) -> Image:
        """(H, W, 3) picture of frame k without noise."""
        self._pose(k)
        return self.picture()

    def depth(self, k: int) -> NDArray[np.float32]:
        """(H, W) exact depth of frame k in m, along the camera's z."""
        self._pose(k)
        return self.depth_m()

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
        if self._T_world_camera is not None:
            self._move_camera(self._T_world_camera[k])
        self._place()

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

    def _add_vessel(self, name: str, vessel: Vessel, group: int) -> None:
        look = vessel_look(self._rng, vessel)
        self.notes[f"{name}_look"] = {"print": look.kind, "color_rgb": [round(float(c), 3) for c in look.color_rgb]}
        self._add_mesh(name, vessel.mesh, look, None, group)

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
