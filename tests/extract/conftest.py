from __future__ import annotations

import os
from itertools import product
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")  # before anything imports the hub's client


def _save(network: object, processor: object, folder: Path) -> None:
    network.eval().save_pretrained(folder)  # type: ignore[attr-defined]
    processor.save_pretrained(folder)  # type: ignore[attr-defined]


def _patch_encoders(folder: Path) -> None:
    from transformers import (
        BitImageProcessor,
        Dinov2WithRegistersConfig,
        Dinov2WithRegistersModel,
        DINOv3ViTConfig,
        DINOv3ViTImageProcessor,
        DINOv3ViTModel,
    )

    small = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2}
    dinov2 = Dinov2WithRegistersConfig(
        **small, patch_size=14, image_size=518, num_register_tokens=4, layerscale_value=1.0
    )
    processor = BitImageProcessor(
        size={"shortest_edge": 256}, crop_size={"height": 224, "width": 224},
        image_mean=[0.485, 0.456, 0.406], image_std=[0.229, 0.224, 0.225],
    )  # fmt: skip
    _save(Dinov2WithRegistersModel(dinov2), processor, folder / "dinov2-small")
    dinov3 = DINOv3ViTConfig(**small, intermediate_size=64, patch_size=16, num_register_tokens=4, layerscale_value=1.0)
    _save(DINOv3ViTModel(dinov3), DINOv3ViTImageProcessor(size={"height": 224, "width": 224}), folder / "dinov3-small")


def _bert_tokenizer() -> object:
    from transformers import BertTokenizer

    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "objects", "mug", "kettle", "##s"]
    return BertTokenizer(vocab={word: index for index, word in enumerate(words)})


def _detector(folder: Path) -> None:
    from transformers import (
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessor,
        GroundingDinoProcessor,
        SwinConfig,
    )

    swin = SwinConfig(
        image_size=128, embed_dim=16, depths=[1, 1, 1, 1], num_heads=[1, 2, 2, 2], window_size=4,
        out_features=["stage2", "stage3", "stage4"],
    )  # fmt: skip
    text = {
        "model_type": "bert", "vocab_size": 10, "hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2,
        "intermediate_size": 32, "max_position_embeddings": 256,
    }  # fmt: skip
    config = GroundingDinoConfig(
        backbone_config=swin, text_config=text, d_model=32, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=32,
        decoder_ffn_dim=32, encoder_attention_heads=2, decoder_attention_heads=2, num_queries=10, max_text_len=256,
        num_feature_levels=4, encoder_n_points=2, decoder_n_points=2,
    )  # fmt: skip
    images = GroundingDinoImageProcessor(size={"shortest_edge": 128, "longest_edge": 192})
    _save(
        GroundingDinoForObjectDetection(config),
        GroundingDinoProcessor(images, _bert_tokenizer()),
        folder / "grounding-dino-tiny",
    )


def _masks(folder: Path) -> None:
    from transformers import Sam2ImageProcessor, Sam2VideoConfig, Sam2VideoModel
    from transformers.models.sam2_video.configuration_sam2_video import Sam2VideoMaskDecoderConfig

    hiera = {
        "hidden_size": 8, "num_attention_heads": 1, "image_size": [128, 128], "blocks_per_stage": [1, 1, 2, 1],
        "embed_dim_per_stage": [8, 16, 32, 64], "num_attention_heads_per_stage": [1, 2, 4, 8],
        "window_size_per_stage": [4, 4, 4, 4], "global_attention_blocks": [3],
        "window_positional_embedding_background_size": [4, 4],
    }  # fmt: skip
    vision = {
        "backbone_config": {"model_type": "sam2_hiera_det_model", **hiera}, "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]], "fpn_hidden_size": 128,
    }  # fmt: skip
    config = Sam2VideoConfig(
        vision_config=vision, prompt_encoder_config={"image_size": 128, "hidden_size": 128},
        mask_decoder_config=Sam2VideoMaskDecoderConfig(
            hidden_size=128, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32
        ),
        image_size=128, memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_num_attention_heads=1, memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[8, 8], memory_encoder_hidden_size=128, memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128, memory_fuser_num_layers=1, memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
    )  # fmt: skip
    images = Sam2ImageProcessor(size={"height": 128, "width": 128}, mask_size={"height": 32, "width": 32})
    _save(Sam2VideoModel(config), images, folder / "sam2-small")


def _depth(folder: Path) -> None:
    from transformers import (
        DepthAnythingConfig,
        DepthAnythingForDepthEstimation,
        DPTImageProcessor,
        ZoeDepthConfig,
        ZoeDepthForDepthEstimation,
        ZoeDepthImageProcessor,
    )

    dinov2 = {
        "model_type": "dinov2", "hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2, "patch_size": 14,
        "image_size": 56, "out_indices": [1, 2, 3, 4], "reshape_hidden_states": False, "apply_layernorm": True,
    }  # fmt: skip
    anything = DepthAnythingConfig(
        backbone_config=dinov2, reassemble_hidden_size=32, patch_size=14, neck_hidden_sizes=[8, 8, 16, 16],
        fusion_hidden_size=16, head_hidden_size=8, depth_estimation_type="metric", max_depth=20,
    )  # fmt: skip
    dpt = DPTImageProcessor(
        size={"height": 518, "width": 518}, keep_aspect_ratio=True, ensure_multiple_of=14, do_pad=False,
        image_mean=[0.485, 0.456, 0.406], image_std=[0.229, 0.224, 0.225], resample=3,
    )  # fmt: skip
    _save(DepthAnythingForDepthEstimation(anything), dpt, folder / "depth-anything-small")
    beit = {
        "model_type": "beit", "hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2, "patch_size": 16,
        "intermediate_size": 64, "image_size": 384, "out_indices": [1, 2, 3, 4], "reshape_hidden_states": False,
        "use_relative_position_bias": True,
    }  # fmt: skip
    bins = [{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}]
    zoe = ZoeDepthConfig(
        backbone_config=beit, neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=16,
        reassemble_factors=[4, 2, 1, 0.5],
        bottleneck_features=16, num_relative_features=8, bin_embedding_dim=16,
        num_attractors=[4, 2, 2, 1], bin_configurations=bins,
        num_patch_transformer_layers=1, patch_transformer_hidden_size=16, patch_transformer_intermediate_size=16,
        patch_transformer_num_attention_heads=2,
    )  # fmt: skip
    _save(
        ZoeDepthForDepthEstimation(zoe),
        ZoeDepthImageProcessor(size={"height": 384, "width": 512}, ensure_multiple_of=32),
        folder / "zoedepth",
    )


def _words(folder: Path) -> None:
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace
    from transformers import (
        CLIPConfig,
        CLIPImageProcessor,
        CLIPModel,
        CLIPTokenizer,
        PreTrainedTokenizerFast,
        SiglipConfig,
        SiglipImageProcessor,
        SiglipModel,
    )

    body = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    alphabet = "abcdefghijklmnopqrstuvwxyz"
    letters = {letter + end: k for k, (letter, end) in enumerate(product(alphabet, ("", "</w>")))}
    vocabulary = letters | {"<|startoftext|>": len(letters), "<|endoftext|>": len(letters) + 1}
    ends = {"bos_token_id": len(letters), "eos_token_id": len(letters) + 1, "pad_token_id": len(letters) + 1}
    clip = CLIPConfig(
        text_config={**body, **ends, "vocab_size": len(vocabulary), "max_position_embeddings": 77},
        vision_config={**body, "image_size": 224, "patch_size": 32}, projection_dim=16,
    )  # fmt: skip
    _save(CLIPModel(clip), CLIPImageProcessor(), folder / "clip-large")
    CLIPTokenizer(vocab=vocabulary, merges=[]).save_pretrained(folder / "clip-large")
    known = ["<pad>", "<unk>", "a", "photo", "of", "an", "mug", "kettle"]
    words = Tokenizer(WordLevel({word: index for index, word in enumerate(known)}, unk_token="<unk>"))
    words.pre_tokenizer = Whitespace()
    siglip = SiglipConfig(
        text_config={**body, "vocab_size": len(known), "max_position_embeddings": 64, "projection_size": 32},
        vision_config={**body, "image_size": 224, "patch_size": 32},
    )  # fmt: skip
    images = SiglipImageProcessor(size={"height": 224, "width": 224}, image_mean=[0.5] * 3, image_std=[0.5] * 3)
    _save(SiglipModel(siglip), images, folder / "siglip-base")
    PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", unk_token="<unk>").save_pretrained(
        folder / "siglip-base"
    )


BUILDERS = (_patch_encoders, _detector, _masks, _depth, _words)


@pytest.fixture(scope="session")
def tiny_models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A models folder with a tiny random network of every kind, under the names of real ones."""
    import torch
    from transformers.utils import logging

    logging.disable_progress_bar()
    folder = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    for build in BUILDERS:
        build(folder)
    return folder
