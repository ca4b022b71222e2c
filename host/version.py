"""The version, for every room."""

VERSION = "0.1.0"
