from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from vid2demo.cli import main
from vid2demo.extract.choose import NEEDED, choose
from vid2demo.extract.errors import UserError
from vid2demo.extract.model_folder import FOLDER_VARIABLE, RECEIPT, find_folder, models_folder, require_folder
from vid2demo.extract.models import MODELS, cards_for, model_card
from vid2demo.extract.models_commands import ModelsList
from vid2demo.extract.neural_tracks import NeuralTracks
from vid2demo.extract.protocols import PointTracker

COMMIT = "0d9846e56b43a21fa46d7f3f5070f0506a5795a9"  # of dinov2-small


def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "import sys; from vid2demo.cli import main; sys.exit(main())", *words],
        capture_output=True, text=True, timeout=120, check=False, env={**os.environ, **environment},
    )  # fmt: skip


def test_every_card_is_complete() -> None:
    assert len({card.repository for card in MODELS.values()}) == len(MODELS)
    for card in MODELS.values():
        assert re.fullmatch(r"[\w.-]+/[\w.-]+", card.repository)
        assert re.fullmatch(r"[0-9a-f]{40}", card.revision)
        assert card.size_mb > 50
        assert card.licence
        assert card.architectures or card.checkpoint
    assert len({card.revision for card in MODELS.values()}) == len(MODELS)
    assert {part for parts in NEEDED.values() for part in parts} == {card.part for card in MODELS.values()}


def test_the_list_says_which_licences_forbid_commercial_use(tmp_path: Path) -> None:
    command = ModelsList(models_dir=tmp_path)
    lines = command.words(command.do()).splitlines()
    told = {line.split()[0] for line in lines if "(non-commercial)" in line}
    assert told == {"depth-anything-large", "cotracker"}
    assert any(line.startswith("clip-large") and "MIT, not on their page" in line for line in lines)


def test_first_choice_of_each_part_is_the_papers() -> None:
    first = {part: cards_for(part)[0].name for parts in NEEDED.values() for part in parts}
    assert first == {
        "features": "dinov2-large", "detector": "grounding-dino-base", "masks": "sam2-large", "depth": "zoedepth",
        "words": "clip-bigg", "tracks": "cotracker",
    }  # fmt: skip


def test_unknown_models_name_what_comes_near() -> None:
    with pytest.raises(UserError, match="did you mean dinov2-large"):
        model_card("dinov2-larg")
    with pytest.raises(UserError, match=r"there are dinov2-large, .*cotracker"):
        model_card("xyz")
    with pytest.raises(UserError, match="model zoedepth is for depth, not for words; take clip-bigg or"):
        model_card("zoedepth", "words")


def test_models_folder_is_the_given_one_else_the_environments(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "there"))
    assert models_folder() == tmp_path / "there"
    assert models_folder(tmp_path) == tmp_path
    monkeypatch.delenv(FOLDER_VARIABLE)
    assert models_folder() == Path.home() / ".cache/vid2demo/models"


def test_shards_must_all_be_there(tiny_models: Path, tmp_path: Path) -> None:
    folder = tmp_path / "clip-bigg"
    shutil.copytree(tiny_models / "clip-large", folder)
    (folder / "model.safetensors").rename(folder / "model-00001-of-00002.safetensors")
    index = {"weight_map": {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    found, why = find_folder(model_card("clip-bigg"), tmp_path)
    assert found is None
    assert why.endswith("lacks model-00002-of-00002.safetensors")
    (folder / "model-00002-of-00002.safetensors").touch()
    assert require_folder(model_card("clip-bigg"), tmp_path) == folder


def test_what_the_hubs_own_tools_fetched_is_found(
    tiny_models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = model_card("dinov2-small")
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    repository = tmp_path / "hub/models--facebook--dinov2-with-registers-small"
    shutil.copytree(tiny_models / "dinov2-small", repository / "snapshots" / COMMIT)
    found, where = find_folder(card, tmp_path / "none")
    assert found == repository / "snapshots" / COMMIT
    assert where.startswith("the hub's cache")
    (repository / "snapshots" / COMMIT).rename(repository / "snapshots" / ("0" * 40))  # another revision
    assert find_folder(card, tmp_path / "none")[0] is None


def test_damaged_configuration_is_named(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "clip-large", tmp_path / "clip-large")
    (tmp_path / "clip-large/config.json").write_text("{")
    with pytest.raises(UserError, match=r"config\.json is damaged .*; fetch the model again"):
        find_folder(model_card("clip-large"), tmp_path)


# Fetching: against a hub on this machine that answers as the real one does.


class _Hub(BaseHTTPRequestHandler):
    files: ClassVar[dict[str, bytes]]
    gated = False

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        _, _, name = self.path.partition(f"/resolve/{COMMIT}/")
        if "/tree/" in self.path:
            tree = [{"type": "file", "path": p, "size": len(b), "oid": "0" * 40} for p, b in self.files.items()]
            self._answer(json.dumps(tree).encode())
        elif self.path.startswith("/api/models/"):
            listing = [{"rfilename": file} for file in self.files]
            self._answer(json.dumps({"id": "x/y", "sha": COMMIT, "siblings": listing}).encode())
        elif type(self).gated:
            self._answer(b"", 403, {"X-Error-Code": "GatedRepo", "X-Error-Message": "accept it first"})
        elif name in self.files:
            tag = hashlib.sha256(self.files[name]).hexdigest()
            self._answer(self.files[name], 200, {"ETag": f'"{tag}"', "X-Repo-Commit": COMMIT})
        else:
            self._answer(b"", 404, {"X-Error-Code": "EntryNotFound"})

    def _answer(self, body: bytes, status: int = 200, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for key, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def hub(tiny_models: Path) -> Iterator[tuple[str, type[_Hub]]]:
    class Hub(_Hub):
        files: ClassVar = {path.name: path.read_bytes() for path in (tiny_models / "dinov2-small").iterdir()}

    Hub.files["pytorch_model.bin"] = b"a pickle"
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", Hub
    server.shutdown()
    server.server_close()


def test_pull_fetches_the_pinned_revision_and_no_pickles(
    hub: tuple[str, type[_Hub]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address, kind = hub
    where = {"HF_ENDPOINT": address, "HF_HUB_OFFLINE": "0", "HF_HOME": str(tmp_path / "hf")}
    words = ("models", "pull", "dinov2-small", "--models-dir", str(tmp_path), "--json")
    done = run(*words, **where)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "dinov2-small"
    assert json.loads(done.stdout) == {
        "model": "dinov2-small", "folder": str(folder), "revision": COMMIT, "licence": "Apache-2.0",
    }  # fmt: skip
    assert not (folder / "pytorch_model.bin").exists()
    assert (folder / "model.safetensors").read_bytes() == kind.files["model.safetensors"]
    assert json.loads((folder / RECEIPT).read_text())["revision"] == COMMIT
    kind.files = {}
    assert run(*words, **where).returncode == 0  # it is there: the hub is not asked again
    main(["models", "list", "--models-dir", str(tmp_path), "--json"])
    listed = json.loads(capsys.readouterr().out)["models"]
    assert [name for name, row in listed.items() if row["folder"]] == ["dinov2-small"]
    main(["models", "path", "dinov2-small", "--models-dir", str(tmp_path)])
    assert capsys.readouterr().out.strip() == str(folder)


def test_gated_models_say_what_to_do(hub: tuple[str, type[_Hub]], tmp_path: Path) -> None:
    address, kind = hub
    kind.gated = True
    where = {"HF_ENDPOINT": address, "HF_HUB_OFFLINE": "0", "HF_HOME": str(tmp_path / "hf")}
    done = run("models", "pull", "dinov2-small", "--models-dir", str(tmp_path), **where)
    assert done.returncode == 2
    assert "licence be accepted" in done.stderr
    assert "`hf auth login`" in done.stderr


def test_offline_pull_says_how_to_bring_the_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", "pull", "zoedepth", "--models-dir", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "vid2demo models pull zoedepth --models-dir DIR" in told
    assert f"copy DIR/zoedepth to {tmp_path}/zoedepth" in told


def test_list_shows_every_model_and_path_says_how_to_get_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--models-dir", str(tmp_path)]
    main(["models", "list", *where])
    shown = capsys.readouterr().out
    assert all(re.search(rf"^{name} .* no ", shown, re.MULTILINE) for name in MODELS)
    assert main(["models", "path", "sam2-small", *where]) == 2
    assert f"vid2demo models pull sam2-small --models-dir {tmp_path}" in capsys.readouterr().err
    assert main(["models", "path", *where]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path)


# Choosing


def test_auto_takes_the_network_whose_weights_are_at_hand(tiny_models: Path) -> None:
    chosen = choose("features", lambda: "classical", models_dir=tiny_models, device="cpu", options={"grid": 4})
    assert chosen.level == "foundation"
    assert chosen.models == ("dinov2-small",)
    assert chosen.made.crop_px == 56  # type: ignore[attr-defined]
    assert chosen.line() == f"features: dinov2-small (weights in {tiny_models / 'dinov2-small'})"
    assert chosen.header() == {"level": "foundation", "models": ["dinov2-small"], "why": chosen.why}
    both = choose("segmenter", lambda: "classical", models_dir=tiny_models, device="cpu")
    assert both.models == ("grounding-dino-tiny", "sam2-small")
    assert both.line().startswith("segmenter: grounding-dino-tiny and sam2-small (weights in ")


def test_auto_falls_back_to_the_classical_way_and_says_why(tiny_models: Path, tmp_path: Path) -> None:
    for role in NEEDED:
        chosen = choose(role, lambda: "classical", models_dir=tmp_path)
        assert (chosen.level, chosen.made, chosen.models) == ("classical", "classical", ())
        assert chosen.line().startswith(f"{role}: classical (no weights for ")
        assert f"vid2demo models pull {cards_for(NEEDED[role][0])[0].name} --models-dir {tmp_path}" in chosen.why
    shutil.copytree(tiny_models / "grounding-dino-tiny", tmp_path / "grounding-dino-tiny")
    assert choose("segmenter", lambda: "classical", models_dir=tmp_path).why.startswith("no weights for masks")


def test_named_level_or_model_is_kept_to(tiny_models: Path, tmp_path: Path) -> None:
    chosen = choose("features", lambda: 1, level="classical", models_dir=tiny_models)
    assert (chosen.made, chosen.why) == (1, "it was asked for")
    third = choose("features", lambda: 1, models=("dinov3-small",), models_dir=tiny_models, device="cpu")
    assert third.models == ("dinov3-small",)
    for settings in ({"level": "foundation"}, {"models": ("dinov2-large",)}):
        with pytest.raises(UserError, match=f"`vid2demo models pull dinov2-large --models-dir {tmp_path}`"):
            choose("features", lambda: 1, models_dir=tmp_path, **settings)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="leave out one"):
        choose("features", lambda: 1, level="classical", models=("dinov2-small",))
    with pytest.raises(UserError, match="model zoedepth is for depth, which is not a part of features"):
        choose("features", lambda: 1, models=("dinov2-small", "zoedepth"), models_dir=tiny_models)


def test_broken_weights_are_told_not_passed_over(tiny_models: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_models / "dinov2-small", tmp_path / "dinov2-small")
    (tmp_path / "dinov2-small/model.safetensors").write_bytes(b"broken")
    with pytest.raises(UserError, match="cannot be read as dinov2-small"):
        choose("features", lambda: 1, models_dir=tmp_path, device="cpu")


def test_tracks_without_their_package_say_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="vid2demo models pull cotracker"):
        NeuralTracks(models_dir=tmp_path)
    (tmp_path / "cotracker").mkdir()
    (tmp_path / "cotracker/scaled_offline.pth").write_bytes(b"x")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    monkeypatch.setattr("importlib.util.find_spec", _without_cotracker)
    with pytest.raises(UserError, match="cotracker is not installed"):
        NeuralTracks(models_dir=tmp_path, device="cpu")


PREDICTOR = """
import torch

class CoTrackerPredictor(torch.nn.Module):
    def __init__(self, checkpoint, offline, window_len):
        super().__init__()
        assert checkpoint is None and offline
        self.interp_shape = (24, 32)
        self.model = torch.nn.Linear(1, 1)

    def forward(self, video, queries, backward_tracking):
        assert backward_tracking and video.shape[3:] == self.interp_shape
        frame, at = queries[..., 0], queries[..., 1:]
        moved = torch.arange(video.shape[1])[None, :, None] - frame[:, None]
        tracks = at[:, None] + moved[..., None] * torch.tensor([1.0, 0.5])
        return tracks, moved < 2
"""


@pytest.mark.slow
def test_points_are_given_to_cotracker_at_its_own_size_and_brought_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package cannot be had here: a stand-in with its interface, where torch.hub keeps it, moves every point."""
    import torch

    package = tmp_path / "hub/hub/facebookresearch_co-tracker_main/cotracker"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "predictor.py").write_text(PREDICTOR)
    (tmp_path / "cotracker").mkdir()
    torch.save({"model": torch.nn.Linear(1, 1).state_dict()}, tmp_path / "cotracker/scaled_offline.pth")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    monkeypatch.setattr(sys, "path", [*sys.path])
    tracker = NeuralTracks(models_dir=tmp_path, device="cpu")
    assert isinstance(tracker, PointTracker)
    assert tracker.name == "cotracker3-offline"
    frames = np.zeros((4, 47, 94, 3), np.uint8)  # 46 and 93 steps between pixels; the network has 23 and 31
    points = np.array([[30.0, 20.0], [60.0, 10.0]], np.float32)
    found = tracker.track(frames, np.array([0, 2]), points)
    for k, (first, second) in enumerate(zip(found.pixels_px[:, 0], found.pixels_px[:, 1], strict=True)):
        np.testing.assert_allclose(first, [30 + 3 * k, 20 + k], atol=1e-4)
        np.testing.assert_allclose(second, [60 + 3 * (k - 2), 10 + (k - 2)], atol=1e-4)
    np.testing.assert_array_equal(found.visible[:, 0], [True, True, False, False])
    assert tracker.track(frames, np.zeros(0, np.int64), points[:0]).pixels_px.shape == (4, 0, 2)
    for name in ("cotracker", "cotracker.predictor"):
        del sys.modules[name]


def _without_cotracker(name: str) -> object | None:
    return None if name == "cotracker" else object()
