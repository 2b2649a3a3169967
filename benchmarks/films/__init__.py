"""Whole films against the truth."""
