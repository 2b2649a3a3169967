"""Random scenes by the thousand: what breaks, how often, and which seed shows it again."""
