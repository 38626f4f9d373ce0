"""Networks of transformers with a few random weights, saved as users' folders are."""

from pathlib import Path

import pytest
import torch


def tiny_mask2former(folder: Path) -> Path:
    tf = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = tf.SwinConfig(
        image_size=64, embed_dim=12, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    config = tf.Mask2FormerConfig(
        backbone_config=backbone, feature_size=32, mask_feature_size=32, hidden_dim=32,
        encoder_feedforward_dim=16, encoder_layers=1, decoder_layers=2, num_attention_heads=2,
        dim_feedforward=32, num_queries=6,
        id2label={0: "person", 1: "chair", 2: "couch", 3: "dining table"},
    )  # fmt: skip
    tf.Mask2FormerForUniversalSegmentation(config).save_pretrained(folder)
    tf.Mask2FormerImageProcessor(
        size={"shortest_edge": 64, "longest_edge": 128}, num_labels=4, ignore_index=255
    ).save_pretrained(folder)
    return folder


def tiny_vitpose(folder: Path) -> Path:
    tf = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = tf.VitPoseBackboneConfig(
        image_size=(64, 48), patch_size=(16, 16), hidden_size=16, num_hidden_layers=1,
        num_attention_heads=2, out_features=["stage1"],
    )  # fmt: skip
    config = tf.VitPoseConfig(
        backbone_config=backbone, num_labels=17, use_simple_decoder=True, scale_factor=4
    )
    tf.VitPoseForPoseEstimation(config).save_pretrained(folder)
    tf.VitPoseImageProcessor(size={"height": 64, "width": 48}).save_pretrained(folder)
    return folder
