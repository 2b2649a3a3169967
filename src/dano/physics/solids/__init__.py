"""Signed distances of solids."""
