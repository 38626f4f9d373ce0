"""Networks of transformers with a few random weights, saved as users' folders are."""

import json
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


def tiny_oneformer(folder: Path) -> Path:
    """With the files of the published ones: the classes lie in the folder itself."""
    tf = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = tf.SwinConfig(
        image_size=64, embed_dim=12, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    names = {0: "person", 1: "chair", 2: "couch", 3: "wall-other-merged"}
    config = tf.OneFormerConfig(
        backbone_config=backbone, num_queries=6, conv_dim=32, mask_dim=32, hidden_dim=32,
        encoder_feedforward_dim=16, encoder_layers=1, decoder_layers=3, num_attention_heads=2,
        dim_feedforward=32, text_encoder_width=32, text_encoder_num_layers=1,
        text_encoder_vocab_size=600, text_encoder_n_ctx=4, id2label=names,
    )  # fmt: skip
    tf.OneFormerForUniversalSegmentation(config).save_pretrained(folder)
    classes = {str(k): {"name": n, "isthing": int(k < 3)} for k, n in names.items()}
    (folder / "classes.json").write_text(json.dumps(classes))
    letters = [c + end for end in ("", "</w>") for c in "abcdefghijklmnopqrstuvwxyz"]
    ends = ["<|startoftext|>", "<|endoftext|>"]
    vocab = {word: i for i, word in enumerate([*letters, *ends])}
    tokenizer = tf.CLIPTokenizer(vocab=vocab, merges=[])
    images = tf.OneFormerImageProcessorPil(
        size={"shortest_edge": 64, "longest_edge": 128}, num_labels=4, ignore_index=255,
        repo_path=str(folder), class_info_file="classes.json", num_text=2,
    )  # fmt: skip
    tf.OneFormerProcessor(images, tokenizer).save_pretrained(folder)
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


def tiny_sam2(folder: Path) -> Path:
    tf = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = tf.Sam2HieraDetConfig(
        hidden_size=8, num_attention_heads=1, image_size=[128, 128], blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64], num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[4, 4, 4, 4], global_attention_blocks=[3],
        window_positional_embedding_background_size=[2, 2],
    )  # fmt: skip
    vision = tf.Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], fpn_hidden_size=128,
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
    )  # fmt: skip
    config = tf.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 128, "image_size": 128, "mask_input_channels": 4},
        mask_decoder_config={
            "hidden_size": 128, "mlp_dim": 16, "num_attention_heads": 2, "num_hidden_layers": 1,
            "iou_head_hidden_dim": 16,
        },
        image_size=128, memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_num_attention_heads=1, memory_attention_feed_forward_hidden_size=16,
        memory_attention_rope_feat_sizes=[8, 8], memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64, mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=16, memory_fuser_num_layers=1,
    )  # fmt: skip
    tf.Sam2VideoModel(config).save_pretrained(folder)
    return folder
