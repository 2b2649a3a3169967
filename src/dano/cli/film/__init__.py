"""`dano film`: from photographs and a film to a simulation."""

from dano.cli.film._arguments import Film as Film, STAGES as STAGES
