"""The paper's tables, and the figures it printed."""
