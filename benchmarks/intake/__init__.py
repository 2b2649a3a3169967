"""Files as people have them: which load, which are refused rightly or wrongly, which are read wrongly."""
