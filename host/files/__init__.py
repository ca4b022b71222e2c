"""Reading of user files within size limits, and atomic writing of files."""
