"""Bodies on joints in the kernels: kinematics, momentum balance, loops, and their linear systems."""
