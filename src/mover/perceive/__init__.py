"""From raw video to a capture: frames, a steady camera, masks, keypoints, a first scene."""
