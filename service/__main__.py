"""``python -m service``: the same as the command ``tandem``."""

from service.cli.main import main

if __name__ == "__main__":
    main()
