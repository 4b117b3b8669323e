"""Whole experiments: the paper's tables beside ours."""
