"""Poses of known objects in rendered films, against the truth."""
