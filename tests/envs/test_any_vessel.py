"""From any vessel, of the library or from a file, to a pour that empties it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vid2demo.envs.builtin import arm_trajectory, builtin_reference, emptying_tilt_deg, pour_reference
from vid2demo.envs.collision import CollisionChecker
from vid2demo.envs.kinematics import limit_margin_rad, panda_chain
from vid2demo.envs.panda import DQ_MAX_RAD_S
from vid2demo.envs.placement import build_reference
from vid2demo.envs.pouring import PandaPourEnv
from vid2demo.envs.reference import Reference, minimum_jerk
from vid2demo.envs.vessel_geometry import gripper_half_width_m
from vid2demo.extract.errors import UserError
from vid2demo.extract.geometry import focal_prior_camera_matrix, invert_pose, look_at, make_pose
from vid2demo.extract.meshes import load_mesh, mesh_sha256
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessel_from_mesh import vessel_from_mesh
from vid2demo.extract.vessels import CATEGORIES, Vessel, make_vessel

SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "meshes"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs the meshes in ../shared/data")


def poured(reference: Reference, particles: int = 100) -> dict[str, float]:
    """The last info of an episode that follows a reference."""
    env = PandaPourEnv(reference, num_particles=particles)
    env.reset(seed=0)
    q_rad = arm_trajectory(reference).astype(np.float32)
    info = {}
    for k in range(env._max_episode_steps):
        *_, info = env.step(q_rad[min(k + 1, len(q_rad) - 1)])
    env.close()
    return info


def check_motion(reference: Reference, brushes_m: float = 0.0) -> None:
    """The arm follows within its limits and touches nothing deeper than `brushes_m`."""
    q_rad = arm_trajectory(reference)
    T = panda_chain().hand(q_rad) @ reference.T_hand_object
    np.testing.assert_allclose(T, reference.T_world_object, atol=1e-3)
    assert limit_margin_rad(q_rad).min() > 0.015
    assert np.all(np.abs(np.diff(q_rad, axis=0)).max(axis=0) * reference.control_hz < DQ_MAX_RAD_S)
    vessel = reference.vessel()
    width_m = 2 * gripper_half_width_m(vessel, reference.T_hand_object)
    assert 0.0 < width_m < 0.079 or any("in simulation only" in note for note in reference.notes)
    checker = CollisionChecker(
        vessel, reference.T_hand_object, width_m, reference.receptacle(), reference.T_world_receptacle
    )
    assert [found for found in checker.check(q_rad, every=5) if found.depth_m > brushes_m] == []


@pytest.mark.parametrize("category", ["watering_can", "wine_glass", "gooseneck_kettle", "carton"])
def test_the_built_in_pour_is_within_reach_and_touches_nothing(category: str) -> None:
    check_motion(builtin_reference(vessel=make_vessel(category)))


@pytest.mark.slow
@pytest.mark.parametrize("category", ["bowl", "saucepan", "pitcher"])
def test_what_is_awkward_to_hold_or_aim_pours_too(category: str) -> None:
    reference = builtin_reference(vessel=make_vessel(category))
    check_motion(reference)
    info = poured(reference, particles=60)
    assert info["poured_fraction"] >= 0.97
    assert info["spilled_fraction"] <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *CATEGORIES,
        *(
            pytest.param(f"{category}:{seed}", marks=pytest.mark.exhaustive)
            for category in CATEGORIES
            for seed in (1, 2)
        ),
    ],
)
def test_the_built_in_pour_empties_every_vessel_of_the_library(name: str) -> None:
    from vid2demo.extract.any_vessel import resolve_vessel

    reference = builtin_reference(vessel=resolve_vessel(name))
    check_motion(reference)
    info = poured(reference)
    assert info["poured_fraction"] >= 0.9
    assert info["spilled_fraction"] <= 0.05


def test_a_vessel_from_a_file_is_held_and_poured(tmp_path: Path) -> None:
    mesh = make_vessel("milk_jug").mesh.copy()
    mesh.apply_transform(np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]]))
    mesh.apply_scale(1000)
    mesh.export(tmp_path / "creamer.stl")
    vessel = vessel_from_mesh(tmp_path / "creamer.stl")
    builtin_reference(vessel=vessel).save(tmp_path / "pour.reference.npz")
    reference = Reference.load(tmp_path / "pour.reference.npz")
    check_motion(reference)
    info = poured(reference, particles=60)
    assert info["poured_fraction"] >= 0.97
    assert info["spilled_fraction"] <= 0.02


def test_a_track_in_the_axes_of_a_users_file_becomes_a_motion_of_the_vessel(tmp_path: Path) -> None:
    """The file has y up and its handle elsewhere; what is tracked is the file's frame, what is poured the vessel."""
    R_file_vessel = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    T_file_vessel = make_pose(R_file_vessel, (0.02, -0.01, 0.03))
    mesh = make_vessel("mug").mesh.copy()
    mesh.apply_transform(T_file_vessel)
    mesh.export(tmp_path / "mug.ply")
    time_s = np.arange(100) / 25
    tilt_rad = np.deg2rad(60) * minimum_jerk((time_s - 1.0) / 2.0)
    T_table_vessel = np.tile(np.eye(4), (100, 1, 1))
    T_table_vessel[:, :3, :3] = Rotation.from_rotvec(np.outer(tilt_rad, [0.0, 1.0, 0.0])).as_matrix()
    T_table_vessel[:, 0, 3] = 0.2 * minimum_jerk(time_s / 2.0)
    T_table_vessel[:, 2, 3] = 0.045 + 0.2 * minimum_jerk(time_s / 2.0)
    camera = look_at(np.array([0.1, -0.75, 0.42]), np.array([0.1, 0.0, 0.15]), np.array([0.0, 0.0, 1.0]))
    entry = {"file": str(tmp_path / "mug.ply"), "unit": "auto", "sha256": mesh_sha256(load_mesh(tmp_path / "mug.ply"))}
    T_camera_file = invert_pose(camera) @ T_table_vessel @ invert_pose(T_file_vessel)
    K = focal_prior_camera_matrix(640, 480)
    track = ObjectTrack(T_camera_file, time_s, K, np.ones(100), np.ones(100, bool), {"object": "mug", "mesh": entry})
    reference = build_reference(track, elevation_deg=20.0)
    held = reference.vessel()
    assert held.source is not None
    assert (held.category, held.source.up) == ("mug", "+y")
    assert reference.tilt_rad[0] == pytest.approx(0.0, abs=0.01)
    assert np.rad2deg(reference.tilt_rad.max()) == pytest.approx(60.0, abs=1.0)
    assert reference.T_world_object[0, 2, 3] == pytest.approx(0.045, abs=0.005)
    moved = invert_pose(reference.T_world_object[0]) @ reference.T_world_object[-1]
    np.testing.assert_allclose(moved, invert_pose(T_table_vessel[0]) @ T_table_vessel[-1], atol=0.004)


@pytest.mark.slow
@needs_shared
@pytest.mark.parametrize("name", sorted(path.name for path in SHARED.glob("*.*")))
def test_vessels_found_in_the_wild_are_poured_from(name: str) -> None:
    def load() -> Vessel:
        try:
            return vessel_from_mesh(SHARED / name)
        except UserError:
            return vessel_from_mesh(SHARED / name, open_top=True)

    reference = builtin_reference(vessel=load())
    # The hull of a kettle of six litres brushes the forearm.
    check_motion(reference, brushes_m=0.01 if name == "stovetop_kettle.glb" else 0.0)
    info = poured(reference)
    # A box of six litres with a spout at half its height keeps a corner full.
    assert info["poured_fraction"] >= (0.75 if name == "stovetop_kettle.glb" else 0.9)
    assert info["spilled_fraction"] <= 0.05


def test_shoulders_ask_for_more_tilt_and_spouts_for_less() -> None:
    bowl = make_vessel("bowl")
    tilt_deg = {name: emptying_tilt_deg(make_vessel(name), bowl) for name in ("mug", "vase", "carton", "teapot")}
    assert tilt_deg["teapot"] < tilt_deg["mug"] < tilt_deg["vase"] < tilt_deg["carton"] <= 150.0


def test_a_place_that_was_asked_for_is_kept_or_refused() -> None:
    mug, bowl = make_vessel("mug"), make_vessel("bowl")
    reference = pour_reference(mug, bowl, receptacle_xy_m=(0.45, 0.15))
    np.testing.assert_allclose(reference.T_world_receptacle[:2, 3], (0.45, 0.15))
    with pytest.raises(UserError, match=r"cannot carry the mug.*start_xy_m"):
        pour_reference(mug, bowl, receptacle_xy_m=(1.4, 0.0))
