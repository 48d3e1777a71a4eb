"""GroundingDINO boxes and SAM 2.1 masks behind the protocol `Segmenter` (paper section 3.1, appendix A.1).

Two sets of thresholds, as in FreePose: for single images and for videos. Unlike there, an object that leaves the view
or is hidden for a while keeps its place; only what is too small in the first frame is not begun with.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .model_folder import read_json, require_folder
from .models import model_card
from .protocols import Box, Image, Mask, Proposal
from .torch_models import Precision, described, load_network, load_processor, place

BOXES_AT_ONCE = 32


@dataclass(frozen=True)
class Thresholds:
    """What is kept of what a detector finds.

    box: least score of a box.  text: least score of a word to be a box's label.  area_px, side_px: least area of a
    mask, and least width and height of its extent.  labelled: boxes without any label are dropped.
    """

    box: float
    text: float
    area_px: int
    side_px: int
    labelled: bool = False


FOR_IMAGES = Thresholds(box=0.3, text=0.5, area_px=100, side_px=5)
FOR_VIDEOS = Thresholds(box=0.2, text=0.2, area_px=100, side_px=10, labelled=True)


class NeuralSegmenter:
    """Boxes of GroundingDINO, cut out and carried on by SAM 2.1."""

    def __init__(
        self,
        detector: str = "grounding-dino-base",
        masks: str = "sam2-large",
        *,
        thresholds: Thresholds = FOR_IMAGES,
        models_dir: Path | None = None,
        device: str = "auto",
        precision: Precision = "auto",
    ) -> None:
        """Find the weights; each network is loaded when it is first needed.

        thresholds: FOR_IMAGES or FOR_VIDEOS, which are the paper's.  Raises UserError when weights are missing.
        """
        self._cards = model_card(detector, "detector"), model_card(masks, "masks")
        self._folders = tuple(require_folder(card, models_dir) for card in self._cards)
        self._placement = place(device, precision)
        # GroundingDINO's deformable attention samples its maps in full precision only.
        self._detector_placement = place(device, "full")
        self.thresholds = thresholds

    @property
    def name(self) -> str:
        pairs = zip(self._cards, self._folders, strict=True)
        return "+".join(described(card, folder, self._placement) for card, folder in pairs)

    @cached_property
    def _detector(self) -> tuple[Any, Any]:
        from transformers import AutoModelForZeroShotObjectDetection, AutoProcessor

        card, folder = self._cards[0], self._folders[0]
        network = load_network(AutoModelForZeroShotObjectDetection, card, folder, self._detector_placement)
        return network, load_processor(AutoProcessor, card, folder)

    @cached_property
    def _image_masks(self) -> tuple[Any, Any]:
        from transformers import Sam2ImageProcessor, Sam2Model, Sam2Processor

        card, folder = self._cards[1], self._folders[1]
        network = load_network(Sam2Model, card, folder, self._placement)
        return network, Sam2Processor(load_processor(Sam2ImageProcessor, card, folder))

    @cached_property
    def _video_masks(self) -> tuple[Any, Any]:
        from transformers import Sam2ImageProcessor, Sam2VideoModel, Sam2VideoProcessor, Sam2VideoVideoProcessor

        card, folder = self._cards[1], self._folders[1]
        network = load_network(Sam2VideoModel, card, folder, self._placement, _video_config(folder))
        images = load_processor(Sam2ImageProcessor, card, folder)
        return network, Sam2VideoProcessor(images, Sam2VideoVideoProcessor(size=dict(images.size)))

    def propose(self, rgb: Image, prompt: str = "objects.") -> list[Proposal]:
        """Objects of a picture (H, W, 3), best first; `prompt`: what to look for, "mug. kettle."."""
        found = self.detect(rgb, prompt)
        masks = self.segment(rgb, [box for box, _, _ in found])
        proposals = [Proposal(mask, box, score, label) for mask, (box, score, label) in zip(masks, found, strict=True)]
        return [proposal for proposal in proposals if large_enough(proposal.mask, self.thresholds)]

    def detect(self, rgb: Image, prompt: str = "objects.") -> list[tuple[Box, float, str]]:
        """Boxes (x, y, width, height) [px] within the picture, their scores and labels, best first."""
        import torch

        network, processor = self._detector
        text = as_prompt(prompt)
        inputs = processor(images=rgb, text=text, return_tensors="pt").to(self._detector_placement.device)
        with torch.inference_mode():
            out = network(**inputs)
        (found,) = processor.post_process_grounded_object_detection(
            out, inputs.input_ids, self.thresholds.box, self.thresholds.text, target_sizes=[rgb.shape[:2]]
        )
        entries = []
        for corners, score, label in zip(found["boxes"], found["scores"], found["text_labels"], strict=True):
            box = _box_within(corners.tolist(), rgb)
            if box is not None and (label or not self.thresholds.labelled):
                entries.append((box, float(score), str(label).strip(" .")))
        return sorted(entries, key=lambda entry: -entry[1])

    def segment(self, rgb: Image, boxes_xywh_px: Sequence[Box]) -> list[Mask]:
        """(H, W) mask of the object in each box."""
        import torch

        if not len(boxes_xywh_px):
            return []
        network, processor = self._image_masks
        corners = [[float(x), float(y), float(x + w), float(y + h)] for x, y, w, h in boxes_xywh_px]
        pixels = processor(images=rgb, return_tensors="pt")
        masks: list[Mask] = []
        with torch.inference_mode():
            values = pixels.pixel_values.to(self._placement.device, self._placement.dtype)
            seen = network.get_image_embeddings(values)
            for start in range(0, len(corners), BOXES_AT_ONCE):
                some = processor(
                    input_boxes=[corners[start : start + BOXES_AT_ONCE]], original_sizes=pixels.original_sizes,
                    return_tensors="pt",
                ).input_boxes  # fmt: skip
                boxes = some.to(self._placement.device, self._placement.dtype)
                out = network(image_embeddings=seen, input_boxes=boxes, multimask_output=False)
                (cut,) = processor.post_process_masks(out.pred_masks.float().cpu(), pixels.original_sizes)
                masks += [np.asarray(mask, bool) for mask in cut[:, 0].numpy()]
        return masks

    def propagate(self, frames: Iterable[Image], masks: Sequence[Mask]) -> Iterator[NDArray[np.bool_]]:
        """(K, H, W) masks of K objects in every frame; a hidden object has an empty mask there and is kept.

        Frames are taken one by one, and only as much of the past is kept as the network looks back at.
        """
        import torch

        stream = iter(frames)
        first = next(stream, None)
        if first is None:
            return
        if not len(masks):
            yield from (np.zeros((0, *frame.shape[:2]), bool) for frame in chain([first], stream))
            return
        if any(mask.shape != first.shape[:2] for mask in masks):
            raise UserError(f"masks of {masks[0].shape} px for frames of {first.shape[:2]} px; make them equal")
        network, processor = self._video_masks
        session = processor.init_video_session(
            inference_device=self._placement.device, video_storage_device="cpu", dtype=self._placement.dtype
        )
        memory = 1 + max(network.config.num_maskmem, network.config.max_object_pointers_in_encoder)
        ids = list(range(1, len(masks) + 1))
        for index, frame in enumerate(chain([first], stream)):
            pixels = processor(images=frame, return_tensors="pt")
            if index == 0:
                given = [np.asarray(mask, bool) for mask in masks]
                processor.add_inputs_to_inference_session(session, 0, list(ids), input_masks=given)
            with torch.inference_mode():
                out = network(inference_session=session, frame_idx=index, frame=pixels.pixel_values[0])
            (cut,) = processor.post_process_masks(
                [out.pred_masks.float().cpu()], original_sizes=pixels.original_sizes, binarize=False
            )
            yield np.asarray(cut[:, 0].numpy() > 0)
            _forget(session, index - memory)


def _video_config(folder: Path) -> Any:
    """The network's configuration; transformers 5.5 takes its mask decoder's part for a prompt encoder's."""
    from transformers import Sam2VideoConfig
    from transformers.models.sam2_video.configuration_sam2_video import Sam2VideoMaskDecoderConfig

    config = Sam2VideoConfig.from_pretrained(folder, local_files_only=True)
    if not isinstance(config.mask_decoder_config, Sam2VideoMaskDecoderConfig):
        stated = read_json(folder / "config.json").get("mask_decoder_config") or {}
        config.mask_decoder_config = Sam2VideoMaskDecoderConfig(**stated)
    return config


def as_prompt(words: str) -> str:
    """Words as GroundingDINO reads them: lower case, each thing ended by a full stop. Raises UserError if empty."""
    things = [thing.strip() for thing in words.lower().replace(",", ".").split(".")]
    if not any(things):
        raise UserError('the prompt is empty; name what to look for, such as "mug. kettle." or "objects."')
    return " ".join(f"{thing}." for thing in things if thing)


def large_enough(mask: Mask, thresholds: Thresholds) -> bool:
    """Whether a mask has the least area, width and height."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return False
    sides = rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    return bool(np.count_nonzero(mask) >= thresholds.area_px and min(sides) >= thresholds.side_px)


def _box_within(corners: Sequence[float], rgb: Image) -> Box | None:
    """x, y, width, height of the part of a box that lies in the picture; None when none does."""
    height, width = rgb.shape[:2]
    x0, x1 = np.clip([corners[0], corners[2]], 0, width)
    y0, y1 = np.clip([corners[1], corners[3]], 0, height)
    return (float(x0), float(y0), float(x1 - x0), float(y1 - y0)) if x1 - x0 >= 1 and y1 - y0 >= 1 else None


def _forget(session: Any, before: int) -> None:
    """Drop frames and memories the network does not look at any more; the first frame's masks stay."""
    for index in [k for k in session.processed_frames if k <= before + 1]:
        del session.processed_frames[index]
    for outputs in session.output_dict_per_obj.values():
        for index in [k for k in outputs["non_cond_frame_outputs"] if k <= before]:
            del outputs["non_cond_frame_outputs"][index]
