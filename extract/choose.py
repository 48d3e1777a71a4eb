"""Which level does a part of perception: the paper's networks where their weights are at hand, else the classical way.

Nothing is downloaded here. The choice says in one line what runs and why, and goes into the header of the results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from .errors import UserError
from .model_folder import find_folder, models_folder, pull_command
from .models import ModelCard, Part, cards_for, model_card
from .torch_models import packages_missing

Level = Literal["auto", "foundation", "classical"]
Role = Literal["features", "segmenter", "depth", "words", "tracks"]
# What a role needs: one network of each of these parts.
NEEDED: Mapping[Role, tuple[Part, ...]] = {
    "features": ("features",),
    "segmenter": ("detector", "masks"),
    "depth": ("depth",),
    "words": ("words",),
    "tracks": ("tracks",),
}


@dataclass(frozen=True)
class Chosen[T]:
    """What does a role, at which level and why. made: the implementation.  models: names of its networks."""

    role: Role
    made: T
    level: Literal["foundation", "classical"]
    models: tuple[str, ...]
    why: str

    def line(self) -> str:
        """The choice for a reader."""
        return f"{self.role}: {' and '.join(self.models) or self.level} ({self.why})"

    def header(self) -> dict[str, Any]:
        """The choice for the header of a result."""
        return {"level": self.level, "models": list(self.models), "why": self.why}


def choose[T](
    role: Role,
    classical: Callable[[], T],
    *,
    level: Level = "auto",
    models: tuple[str, ...] = (),
    models_dir: Path | None = None,
    device: str = "auto",
    options: Mapping[str, Any] | None = None,
) -> Chosen[T]:
    """The implementation of a role.

    classical: makes the one without networks.  level: "auto", or which one it must be.  models: names of the networks
    that must be taken, in place of the first whose weights are at hand.  options: further ones of the neural
    implementation.
    Raises UserError when "foundation" or a named model is asked for and its weights or packages are missing.
    """
    wanted = [model_card(name) for name in models]
    if level == "classical":
        if wanted:
            raise UserError(f"--level classical uses no network, but {wanted[0].name} was named; leave out one of them")
        return Chosen(role, classical(), "classical", (), "it was asked for")
    must = level == "foundation" or bool(wanted)
    if missing := packages_missing():
        if must:
            raise UserError(f"{role} by a network needs {', '.join(missing)}; `pip install 'vid2demo[models]'`")
        return Chosen(role, classical(), "classical", (), f"{', '.join(missing)} not installed")
    taken: list[ModelCard] = []
    for part in NEEDED[role]:
        named = [card for card in wanted if card.part == part]
        at_hand = [card for card in named or cards_for(part) if find_folder(card, models_dir)[0] is not None]
        if not at_hand:
            first = (named or list(cards_for(part)))[0]
            if must:
                raise UserError(f"no weights for {part} at hand; get them with `{pull_command(first, models_dir)}`")
            why = f"no weights for {part} in {models_folder(models_dir)}; `{pull_command(first, models_dir)}` gets them"
            return Chosen(role, classical(), "classical", (), why)
        taken.append(at_hand[0])
    if stray := [card.name for card in wanted if card not in taken]:
        raise UserError(f"model {stray[0]} is for {model_card(stray[0]).part}, which is not a part of {role}")
    names = tuple(card.name for card in taken)
    settings = {"models_dir": models_dir, "device": device, **(options or {})}
    # The protocol of the role is what `classical` gives as well.
    made = cast(T, _builder(role)(*names, **settings))
    why = "it was asked for" if must else f"weights in {find_folder(taken[0], models_dir)[1]}"
    return Chosen(role, made, "foundation", names, why)


def _builder(role: Role) -> Callable[..., Any]:
    """The neural implementation of a role; its module is loaded here, for each needs what the others do not."""
    if role == "features":
        from .neural_features import NeuralPatchFeatures

        return NeuralPatchFeatures
    if role == "segmenter":
        from .neural_segment import NeuralSegmenter

        return NeuralSegmenter
    if role == "depth":
        from .neural_depth import NeuralDepth

        return NeuralDepth
    if role == "words":
        from .neural_words import NeuralWords

        return NeuralWords
    from .neural_tracks import NeuralTracks

    return NeuralTracks
