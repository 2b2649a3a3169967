"""How long a stranger waits: the first programs, from empty caches and again."""
