"""``python -m sb3_cure.zoo`` does what the command ``sb3-cure`` does; rl-zoo3's side is in :mod:`sb3_cure.cli.zoo`."""

from sb3_cure.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
