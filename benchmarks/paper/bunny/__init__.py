"""The paper's bunny, pushed by a ball: its mass and friction from ten motions (Sec. V-A)."""
