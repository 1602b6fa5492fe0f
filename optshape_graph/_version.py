"""Version of the package: the last release's, or of the development towards the next."""

__version__ = "0.2.0.dev0"
