"""The fit of bodies to keypoints: E_Body of the paper, in batch over the whole video."""
