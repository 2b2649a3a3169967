"""Objects learned from photographs, at rest and beside the true solids."""
