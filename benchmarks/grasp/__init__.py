"""Two fingers grasp the bunny and lift it: from bad first grasps, how many become good ones."""
