"""Rendered video sequences with truth: what following and several cameras are tested and measured with."""
