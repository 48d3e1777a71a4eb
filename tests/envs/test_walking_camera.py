"""From a clip filmed in walking to what the robot is to do: the camera's motion is no motion of the objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vid2demo.envs.placement import build_reference
from vid2demo.extract.compare import compare_tracks, load_truth
from vid2demo.extract.geometry import invert_pose, rotation_angle_rad
from vid2demo.extract.perceive import ObjectRequest, extract
from vid2demo.extract.synthetic import synthesize
from vid2demo.extract.synthetic_camera import move_camera
from vid2demo.extract.synthetic_motion import PourShape, place_camera, plan_pour
from vid2demo.extract.track import ObjectTrack
from vid2demo.extract.vessels import Vessel, make_vessel


@pytest.mark.slow
def test_a_clip_filmed_in_walking_is_followed_in_the_first_frames_camera(tmp_path: Path) -> None:
    clip = synthesize("mug", 0, tmp_path, seconds=3.0, fps=15.0, size=(320, 240), occluder=False, camera_path="walk")
    requests = []
    for track, role in ((clip.truth, "object"), (clip.receptacle, "receptacle")):
        library = track.header["mesh"]["library"]
        make_vessel(library["category"], **library["params"]).mesh.export(tmp_path / f"{role}.ply")
        requests.append(ObjectRequest(role, clip.boxes_xywh_px[role], tmp_path / f"{role}.ply", "m"))
    K = clip.truth.camera_matrix
    camera = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    tracks = extract(clip.video, requests, out=tmp_path / "out", camera=camera)

    found = ObjectTrack.load(tmp_path / "out" / "object.track.npz")
    words = found.header["camera"]["motion"]
    assert words["kind"] == "moving", words
    assert clip.truth.T_first_camera is not None
    assert found.T_first_camera is not None
    length_m = np.linalg.norm(np.diff(clip.truth.T_first_camera[:, :3, 3], axis=0), axis=1).sum()
    assert words["path_m"] == pytest.approx(length_m, rel=0.1)
    T, T_true = found.T_first_camera, clip.truth.T_first_camera
    assert np.rad2deg(rotation_angle_rad(T[:, :3, :3], T_true[:, :3, :3])).mean() < 1.0
    assert np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1).mean() < 0.04 * length_m
    for name, file in (("object", clip.truth_path), ("receptacle", clip.receptacle_path)):
        truth, track = load_truth(file), tracks[name]
        after = compare_tracks(track, truth).first_camera
        before = compare_tracks(replace(track, T_first_camera=None), truth).first_camera
        assert after is not None
        assert before is not None
        assert after.translation_m < min(0.025, 0.7 * before.translation_m)


@pytest.mark.slow
def test_a_walking_cameras_tracks_make_the_same_reference_as_a_standing_ones() -> None:
    """Both see one pour; the walker's poses alone would make another motion."""
    vessel, bowl = make_vessel("mug", 1), make_vessel("bowl", 2)
    shape = PourShape(
        points_m=np.asarray(vessel.mesh.vertices),
        outlet_m=np.asarray(vessel.outlet.point_m),
        outlet_kind=vessel.outlet.kind,
        receptacle_points_m=np.asarray(bowl.mesh.vertices),
        rim_radius_m=float(bowl.interior.radius_m[-1]),
    )
    path = plan_pour(np.random.default_rng(1), shape, 4.0, 10.0)
    size = (640, 480)
    placed, _ = place_camera(np.random.default_rng(1), path, shape, size)
    camera, T_world_camera = move_camera(np.random.default_rng(0), placed, path, shape, size, "walk")
    count = len(path.time_s)

    def seen(vessel: Vessel, T_world_object: np.ndarray, *, walks: bool) -> ObjectTrack:
        T = T_world_camera if walks else np.tile(T_world_camera[0], (count, 1, 1))
        mesh = {"library": {"category": vessel.category, "params": {k: float(v) for k, v in vessel.params.items()}}}
        mesh |= {"symmetry": vessel.symmetry.to_json()}
        header = {"object": vessel.category, "mesh": mesh, "image_size_px": list(size)}
        poses = invert_pose(T) @ T_world_object
        track = ObjectTrack(poses, path.time_s, camera.camera_matrix, np.ones(count), np.ones(count, bool), header)
        return replace(track, T_first_camera=invert_pose(T_world_camera[0]) @ T) if walks else track

    bowls = np.tile(path.T_world_receptacle, (count, 1, 1))
    walked, stood = (
        build_reference(seen(vessel, path.T_world_object, walks=walks), seen(bowl, bowls, walks=walks))
        for walks in (True, False)
    )
    np.testing.assert_allclose(walked.T_world_object, stood.T_world_object, atol=1e-6)
    bowls_at = [reference.header["receptacle"]["T_world_receptacle"] for reference in (walked, stood)]
    np.testing.assert_allclose(*bowls_at, atol=1e-6)
    unaware = replace(seen(bowl, bowls, walks=True), T_first_camera=None)
    assert np.ptp(unaware.T_camera_object[:, :3, 3], axis=0).max() > 0.02
