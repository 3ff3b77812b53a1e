"""``python -m service``: the same as the command ``tandem``."""

import sys


def main() -> None:
    """Run the command; Ctrl-C while it is loaded ends it as quietly as later on."""
    try:
        from service.cli.main import main as command
    except KeyboardInterrupt:
        sys.exit(130)
    command()


if __name__ == "__main__":
    main()
