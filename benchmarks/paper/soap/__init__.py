"""The real soap: its friction from a video (paper, Sec. V-A)."""
