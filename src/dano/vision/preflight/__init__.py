"""What photographs and films say of themselves in seconds, before anything is learned from them."""

from dano.vision.preflight._slide import check_slide as check_slide, SlideCheck as SlideCheck
from dano.vision.preflight._walk import check_walk as check_walk, WalkCheck as WalkCheck
