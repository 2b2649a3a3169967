"""What neural objects on bodies of MuJoCo models cost, and how still they lie."""
