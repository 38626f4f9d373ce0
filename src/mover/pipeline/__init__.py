"""The stages in order, their settings, and what comes out."""
