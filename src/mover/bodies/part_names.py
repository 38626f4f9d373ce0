"""Names of the parts of a body that touch things."""

PARTS = (
    "left_sole", "right_sole", "seat", "left_thigh", "right_thigh", "back",
    "left_palm", "right_palm", "left_forearm", "right_forearm",
)  # fmt: skip
"""Patches of skin; of thighs and forearms only the undersides."""
