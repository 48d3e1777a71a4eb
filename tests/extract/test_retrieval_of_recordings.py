"""Real things, pointed at in the first frame of a recording, are found among the vessels that ship."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vid2demo.extract.features import ClassicalFeatures
from vid2demo.extract.masks import read_mask
from vid2demo.extract.mesh_sources import library_sources
from vid2demo.extract.mesh_store import MeshStore
from vid2demo.extract.onboarding import onboard
from vid2demo.extract.protocols import Box, Mask
from vid2demo.extract.retrieval import Retriever, look_at_object
from vid2demo.extract.segment import mask_from_box
from vid2demo.extract.templates import ViewSettings
from vid2demo.extract.video import iterate_frames

DATA = Path(__file__).parents[2].parent / "shared/data"
POUR, MUSTARD = DATA / "videos/coffee_pour.mp4", DATA / "tracking/mustard_a"
KETTLE_BOX_PX, MUG_BOX_PX = (345.0, 297.0, 488.0, 342.0), (800.0, 415.0, 192.0, 202.0)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> MeshStore:
    """One vessel of every category, in fewer views than usual."""
    root = tmp_path_factory.mktemp("library") / "db"
    onboard(library_sources(1), root, settings=ViewSettings(count=200))
    return MeshStore.open(root)


def categories(library: MeshStore, video: Path, box_xywh_px: Box | None = None, mask: Mask | None = None) -> list[str]:
    """The categories that are found for what a box or a mask shows in the first frame, best first."""
    rgb = next(iterate_frames(video)).rgb
    if mask is None:
        assert box_xywh_px is not None
        mask = mask_from_box(rgb, box_xywh_px)
    look = look_at_object(ClassicalFeatures(), library.settings.extend, [(rgb, np.asarray(mask))])
    return [hit.about.category for hit in Retriever(library).retrieve(look)]


@pytest.mark.skipif(not POUR.exists(), reason="needs ../shared")
def test_the_kettle_of_a_pour_is_among_the_first_three(library: MeshStore) -> None:
    assert "gooseneck_kettle" in categories(library, POUR, KETTLE_BOX_PX)[:3]


@pytest.mark.skipif(not POUR.exists(), reason="needs ../shared")
def test_the_mug_of_a_pour_is_among_the_first_three(library: MeshStore) -> None:
    assert "mug" in categories(library, POUR, MUG_BOX_PX)[:3]


@pytest.mark.skipif(not MUSTARD.exists(), reason="needs ../shared")
def test_a_mustard_bottle_is_a_container_of_like_shape(library: MeshStore) -> None:
    """Squeezed flat and tapered, it is no vessel of the library: taller than wide, without handle and spout."""
    mask = read_mask(MUSTARD / "mask_first_frame.png", 640, 480)
    found = categories(library, MUSTARD / "video.mp4", mask=mask)
    assert found[0] in ("bottle", "carton", "vase", "thermos"), found
