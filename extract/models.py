"""The neural networks this package can use: where each comes from, at which revision, under which licence, for what.

Nothing is downloaded unless `vid2demo models pull` is called; everything also runs without any of them.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Literal

from .errors import UserError

Part = Literal["features", "detector", "masks", "depth", "words", "tracks"]


@dataclass(frozen=True)
class ModelCard:
    """One network on the Hugging Face hub.

    part: what it does in the method.  revision: the commit that is fetched.  size_mb: of the weights.  licence: of the
    weights, as their page states it; "not on their page" where only their authors' code or paper does.
    architectures: `model_type` in its config.json; what tells a right folder from a wrong one.  gated: its licence has
    to be accepted on the hub before it can be fetched.  checkpoint: the name of the weights where they are not in
    safetensors files.
    """

    name: str
    part: Part
    repository: str
    revision: str
    size_mb: int
    licence: str
    used_for: str
    architectures: tuple[str, ...]
    gated: bool = False
    checkpoint: str | None = None

    @property
    def non_commercial(self) -> bool:
        """Whether the licence forbids commercial use."""
        return "-NC-" in self.licence


_CLIP, _SAM2, _DEPTH_ANYTHING = ("clip",), ("sam2_video", "sam2"), ("depth_anything",)
_DINOV2, _DINOV3, _GROUNDING = ("dinov2_with_registers",), ("dinov3_vit",), ("grounding-dino",)
_DINOV3_LICENCE = "DINOv3 License"
_ELSEWHERE = "not on their page"

# In each part the first is the paper's (or what comes nearest in transformers), and what is looked for first.
_CARDS = (
    ModelCard(
        "dinov2-large", "features", "facebook/dinov2-with-registers-large", "e4c89a4e05589de9b3e188688a303d0f3c04d0f3",
        1217, "Apache-2.0", "retrieval and pose, as in the paper (ViT-L/14 with registers, block 22)", _DINOV2,
    ),
    ModelCard(
        "dinov2-base", "features", "facebook/dinov2-with-registers-base", "a1d738ccfa7ae170945f210395d99dde8adb1805",
        346, "Apache-2.0", "retrieval and pose, faster; the paper's pose tracking", _DINOV2,
    ),
    ModelCard(
        "dinov2-small", "features", "facebook/dinov2-with-registers-small", "0d9846e56b43a21fa46d7f3f5070f0506a5795a9",
        88, "Apache-2.0", "retrieval and pose on a CPU", _DINOV2,
    ),
    ModelCard(
        "dinov3-large", "features", "facebook/dinov3-vitl16-pretrain-lvd1689m",
        "ea8dc2863c51be0a264bab82070e3e8836b02d51", 1213, _DINOV3_LICENCE, "retrieval and pose", _DINOV3, gated=True,
    ),
    ModelCard(
        "dinov3-base", "features", "facebook/dinov3-vitb16-pretrain-lvd1689m",
        "5931719e67bbdb9737e363e781fb0c67687896bc", 343, _DINOV3_LICENCE, "retrieval and pose", _DINOV3, gated=True,
    ),
    ModelCard(
        "dinov3-small", "features", "facebook/dinov3-vits16-pretrain-lvd1689m",
        "114c1379950215c8b35dfcd4e90a5c251dde0d32", 86, _DINOV3_LICENCE, "retrieval and pose on a CPU", _DINOV3,
        gated=True,
    ),
    ModelCard(
        "grounding-dino-base", "detector", "IDEA-Research/grounding-dino-base",
        "12bdfa3120f3e7ec7b434d90674b3396eccf88eb", 933, "Apache-2.0", "boxes of objects, as in the paper", _GROUNDING,
    ),
    ModelCard(
        "grounding-dino-tiny", "detector", "IDEA-Research/grounding-dino-tiny",
        "a2bb814dd30d776dcf7e30523b00659f4f141c71", 689, "Apache-2.0", "boxes of objects, faster", _GROUNDING,
    ),
    ModelCard(
        "sam2-large", "masks", "facebook/sam2.1-hiera-large", "665f8e2ad61cf5f53d65644ff27c8ee525124610", 898,
        "Apache-2.0", "masks in images and videos (the paper: the same network, SAM 2.0)", _SAM2,
    ),
    ModelCard(
        "sam2-small", "masks", "facebook/sam2.1-hiera-small", "ee5bba1d82bb8749febdf90f45e84b687142ba03", 184,
        "Apache-2.0", "masks in images and videos on a CPU", _SAM2,
    ),
    ModelCard(
        "zoedepth", "depth", "Intel/zoedepth-nyu", "52ae69caf7896c927909b3ceab4249c235e16dc1", 1378, "MIT",
        "metric depth, as in the paper (ZoeD-N)", ("zoedepth",),
    ),
    ModelCard(
        "depth-anything-large", "depth", "depth-anything/Depth-Anything-V2-Metric-Indoor-Large-hf",
        "d2fc6a93601aabb1139a3bf0ebfcb4e89c67817f", 1341, f"CC-BY-NC-4.0, {_ELSEWHERE}", "metric depth indoors",
        _DEPTH_ANYTHING,
    ),
    ModelCard(
        "depth-anything-small", "depth", "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
        "8078d68a9c75a972131914f6afd0c1723be0da7f", 99, f"Apache-2.0, {_ELSEWHERE}", "metric depth indoors on a CPU",
        _DEPTH_ANYTHING,
    ),
    ModelCard(
        "clip-bigg", "words", "laion/CLIP-ViT-bigG-14-laion2B-39B-b160k", "743c27bd53dfe508a0ade0f50698f99b39d03bec",
        10160, "MIT", "which size a crop has, as in the paper", _CLIP,
    ),
    ModelCard(
        "clip-large", "words", "openai/clip-vit-large-patch14", "32bd64288804d66eefd0ccbe215aa642df71cc41", 1711,
        f"MIT, {_ELSEWHERE}", "which size a crop has", _CLIP,
    ),
    ModelCard(
        "siglip-large", "words", "google/siglip-so400m-patch14-384", "9fdffc58afc957d1a03a25b10dba0329ab15c2a3", 3513,
        "Apache-2.0", "which size a crop has", ("siglip",),
    ),
    ModelCard(
        "siglip-base", "words", "google/siglip-base-patch16-224", "7fd15f0689c79d79e38b1c2e2e2370a7bf2761ed", 813,
        "Apache-2.0", "which size a crop has, on a CPU", ("siglip",),
    ),
    ModelCard(
        "cotracker", "tracks", "facebook/cotracker3", "b748ec5e5cd4b9f525a94cc544f0be34bbcc22e2", 102, "CC-BY-NC-4.0",
        "points through a video; needs the authors' package `cotracker` as well", (), checkpoint="scaled_offline.pth",
    ),
)  # fmt: skip

MODELS = {card.name: card for card in _CARDS}


def model_card(name: str, part: Part | None = None) -> ModelCard:
    """The card of a name, which must do `part` where that is given. Raises UserError naming those that would do."""
    fitting = [card.name for card in _CARDS if part in (None, card.part)]
    if name in fitting:
        return MODELS[name]
    if name in MODELS:
        raise UserError(f"model {name} is for {MODELS[name].part}, not for {part}; take {' or '.join(fitting)}")
    near = difflib.get_close_matches(name, fitting, 3)
    raise UserError(f"unknown model {name!r}; did you mean {', '.join(near)}?" if near else
                    f"unknown model {name!r}; there are {', '.join(fitting)}")  # fmt: skip


def cards_for(part: Part) -> tuple[ModelCard, ...]:
    """The networks that can do a part, first choice first."""
    return tuple(card for card in _CARDS if card.part == part)
