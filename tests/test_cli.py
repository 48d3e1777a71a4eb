from __future__ import annotations

import json
import subprocess
import sys
import typing
from pathlib import Path

import av
import numpy as np
import pytest
import vid2demo
from vid2demo import cli
from vid2demo.extract.command import Command, Staged
from vid2demo.extract.errors import UserError
from vid2demo.extract.video import VideoWriter


def small_video(path: Path, shade: int = 90) -> Path:
    with VideoWriter(path, 25.0) as writer:
        for _ in range(3):
            writer.write(np.full((64, 96, 3), shade, np.uint8))
    return path


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line on standard error with which a command refuses its input."""
    assert cli.main([str(word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = [line for line in err.splitlines() if not line.startswith("[")]
    assert line.startswith("vid2demo: ")
    assert "Traceback" not in err
    return line


def test_help_names_every_command_and_begins_at_once() -> None:
    code = (
        "import sys\nfrom vid2demo import cli\nstatus = cli.main(['--help'])\n"
        "heavy = ['mujoco', 'cv2', 'trimesh', 'av', 'mink', 'torch', 'lerobot', 'matplotlib', 'numba', 'rich']\n"
        "print(status, [name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "0 []"
    assert all(f"  {name} " in done.stdout for name in cli.COMMANDS)


def test_commands_of_the_design_are_there() -> None:
    wanted = {"run", "extract", "retarget", "simulate", "play", "collect", "replay", "meshes", "synthesize", "report"}
    wanted |= {"export-trajectory", "check-trajectory", "figure"}
    assert {*wanted, "demo", "compare-track"} <= {name.split()[0] for name in cli.COMMANDS}


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_help_of_each_command_has_an_example_and_tells_every_option(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*name.split(), "--help"])
    assert stop.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"For example: vid2demo {name}" in text
    for option, hint in typing.get_type_hints(cli.COMMANDS[name], include_extras=True).items():
        assert "help='" in repr(hint) or 'help="' in repr(hint), f"{option} has no help"
    if issubclass(cli.COMMANDS[name], Staged):
        assert "--out DIR" in text
        assert "--force" in text
    assert "--json" in text


def test_no_command_prints_the_usage_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: vid2demo COMMAND" in capsys.readouterr().out


def test_version_is_the_package_s(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"vid2demo {vid2demo.__version__}\n"


def test_unknown_command_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert "did you mean retarget?" in refused(capsys, "retrget")


@pytest.mark.parametrize("words", [["meshes", "--help"], ["meshes", "-h"], ["meshes"]])
def test_a_word_with_commands_below_it_lists_them(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == (0 if words[1:] else 2)
    told = capsys.readouterr().out
    below = [name for name in cli.COMMANDS if name.startswith("meshes ")]
    assert len(below) >= 3
    assert all(f"  {name} " in told for name in below)
    assert "retarget" not in told


def test_a_word_may_be_a_command_and_have_others_below_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["synthesize", "--help"])
    assert stop.value.code == 0
    told = capsys.readouterr().out
    assert "--without-hand" in told
    assert "  synthesize bop " in told
    assert "did you mean synthesize bop?" in refused(capsys, "synthesize", "bopp", "--out", "runs/tables")


def test_unknown_command_below_a_word_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "meshes", "lst")
    assert "did you mean meshes list?" in line
    assert "meshes export" in line


@pytest.mark.parametrize(
    "words", [["run", "a.mp4", "--object", "mug"], ["run", "a.mp4", "--object", "mug", "--colour"]]
)
def test_wrong_options_exit_with_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2
    assert "--out" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "extract"])
def test_bad_videos_are_one_sentence(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("--object", "mug", "--out", tmp_path / "out")
    assert "does not exist" in refused(capsys, command, tmp_path / "gone.mp4", *out)
    (tmp_path / "empty.mp4").touch()
    assert "empty" in refused(capsys, command, tmp_path / "empty.mp4", *out)
    (tmp_path / "text.mp4").write_text("not a video")
    assert "cannot be read as a video" in refused(capsys, command, tmp_path / "text.mp4", *out)
    sound = tmp_path / "sound.mp4"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 2048), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    assert "no video stream" in refused(capsys, command, sound, *out)
    assert not (tmp_path / "out/run.json").exists()


def test_folder_of_another_video_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = small_video(tmp_path / "coffee.mp4"), small_video(tmp_path / "tea.mp4", shade=120)
    options = ("--object", "no such thing", "--out", tmp_path / "out")
    refused(capsys, "extract", first, *options)
    for command in ("extract", "run"):
        line = refused(capsys, command, second, *options)
        assert "coffee.mp4" in line
        assert "tea.mp4" in line


def test_unknown_object_is_answered_with_the_known_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = small_video(tmp_path / "clip.mp4")
    line = refused(capsys, "run", video, "--object", "teapott", "--out", tmp_path / "out")
    assert "gooseneck_kettle" in line


@pytest.mark.parametrize("name", ["../mug", "a/b", " ", ".mug"])
def test_object_that_cannot_name_a_file_is_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = small_video(tmp_path / "clip.mp4")
    assert "cannot name an object" in refused(capsys, "run", video, "--object", name, "--out", tmp_path / "out")


def test_object_and_receptacle_of_one_name_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = small_video(tmp_path / "clip.mp4")
    options = ("--object", "mug", "--receptacle", "mug", "--out", tmp_path / "out")
    assert "both called 'mug'" in refused(capsys, "run", video, *options)


@pytest.mark.parametrize(
    "words",
    [
        ["retarget", "gone.track.npz"],
        ["simulate", "gone.reference.npz"],
        ["collect", "gone.reference.npz"],
        ["play", "gone.reference.npz"],
        ["play", "--joints", "gone.joints.npz"],
    ],
)
def test_missing_file_is_named(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, *words, "--out", tmp_path / "out.mp4")
    assert words[-1] in line
    assert "does not exist" in line


def test_play_films_a_pour(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "film.mp4"
    words = ["play", "--vessel", "cup", "--particles", "5", "--size", "64", "48", "--out", str(film), "--json"]
    assert cli.main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["shown"] == str(film)
    assert told["position_error_m"] < 0.002
    with av.open(str(film)) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == (64, 48)
    assert "gone" in refused(capsys, "play", "--vessel", "gone", "--out", film)


def test_replay_of_no_dataset_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert str(tmp_path) in refused(capsys, "replay", tmp_path)


def test_meshes_list_and_show_give_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["meshes", "list", "--json"]) == 0
    categories = json.loads(capsys.readouterr().out)["categories"]
    assert {"mug", "gooseneck_kettle"} <= set(categories)
    assert cli.main(["meshes", "show", "mug", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["measures"] == categories["mug"]
    assert all(p["low"] <= p["value"] <= p["high"] for p in shown["parameters"].values())


def test_meshes_list_is_readable(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["meshes", "list"]) == 0
    assert "gooseneck kettle" in capsys.readouterr().out


@pytest.mark.parametrize("file_format", ["obj", "stl", "ply", "glb"])
def test_exported_mesh_is_the_vessel(file_format: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import trimesh
    from vid2demo.extract.vessels import make_vessel

    words = ["meshes", "export", "mug", "--seed", "3", "--format", file_format, "--out", str(tmp_path / "m"), "--json"]
    assert cli.main(words) == 0
    written = json.loads(capsys.readouterr().out)
    mesh = trimesh.load(written["mesh"], force="mesh")
    assert np.allclose(mesh.extents, make_vessel("mug", 3).mesh.extents, atol=1e-5)
    assert json.loads(Path(written["description"]).read_text())["category"] == "mug"


def test_meshes_without_what_they_need_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "needs a category" in refused(capsys, "meshes", "show")
    assert "needs --out" in refused(capsys, "meshes", "export", "mug")
    assert "unknown vessel category" in refused(capsys, "meshes", "show", "hammer")


def test_interruption_says_how_to_go_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(self: Command) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.Report, "do", interrupt)
    assert cli.main(["report", "runs/my coffee"]) == 130
    out, err = capsys.readouterr()
    assert out == ""
    assert err.strip().endswith("type again: vid2demo report 'runs/my coffee'")


def test_errors_of_the_program_itself_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Command) -> None:
        raise ValueError("a fault of ours")

    monkeypatch.setattr(cli.Report, "do", fail)
    with pytest.raises(ValueError, match="a fault of ours"):
        cli.main(["report", "somewhere"])


def test_user_error_is_one_line_from_the_installed_command(tmp_path: Path) -> None:
    command = Path(sys.executable).with_name("vid2demo")
    done = subprocess.run(
        [command, "meshes", "show", "hammer"], capture_output=True, text=True, check=False, timeout=60, cwd=tmp_path
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1


def test_reader_that_goes_away_is_no_error() -> None:
    command = Path(sys.executable).with_name("vid2demo")
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command} --help | head -1"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_user_error_is_a_value_error_for_library_callers() -> None:
    assert issubclass(UserError, ValueError)


def test_compare_track_prints_and_writes_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from vid2demo.extract.geometry import focal_prior_camera_matrix
    from vid2demo.extract.track import ObjectTrack

    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, 3] = np.linspace([0, 0, 0.5], [0.1, 0, 0.6], 5)
    header = {"mesh": {"extents_m": [0.1, 0.1, 0.1]}, "image_size_px": [640, 480]}
    camera, time_s = focal_prior_camera_matrix(640, 480), np.arange(5) / 25
    ObjectTrack(T, time_s, camera, np.ones(5), np.ones(5, bool), header).save(tmp_path / "a.track.npz")
    np.savez(tmp_path / "truth.npz", T_camera_object=T, camera_matrix=camera, time_s=time_s)
    words = ["compare-track", str(tmp_path / "a.track.npz"), str(tmp_path / "truth.npz"), "--symmetry-order", "0"]
    assert cli.main([*words, "--out", str(tmp_path / "figures.json")]) == 0
    assert "aligned_rotation_deg" in capsys.readouterr().out
    written = json.loads((tmp_path / "figures.json").read_text())
    assert cli.main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == written
    assert written["frames"] == 5
    assert written["pose"]["translation_m"] == pytest.approx(0, abs=1e-9)
    assert "negative" in refused(capsys, *words[:-1], "-1")
    assert "gone.npz does not exist" in refused(capsys, *words[:2], tmp_path / "gone.npz")
