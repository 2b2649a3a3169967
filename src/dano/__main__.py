"""`python -m dano`: the command `dano`, of the Python that runs it."""

from dano_start import main

if __name__ == "__main__":
    main()
