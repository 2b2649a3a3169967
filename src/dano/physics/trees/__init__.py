"""Bodies on joints: how joints move bodies, what acts on them, and loops."""
