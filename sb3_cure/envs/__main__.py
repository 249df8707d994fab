"""``python -m sb3_cure.envs``: print the name of the OpenGL renderer, or what is missing."""

import sys

from sb3_cure.envs.rendering import GLUnavailableError, check_gl

if __name__ == "__main__":
    try:
        print(check_gl())
    except GLUnavailableError as error:
        sys.exit(str(error))
