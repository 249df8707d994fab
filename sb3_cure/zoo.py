"""``python -m sb3_cure.zoo`` runs the command ``sb3-cure``; the code for rl-zoo3 is in :mod:`sb3_cure.cli.zoo`."""

from sb3_cure.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
