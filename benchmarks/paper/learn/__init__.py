"""Learning from photographs: pictures, solids and mass properties against what they should be."""
