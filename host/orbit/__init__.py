"""The satellite's orbit: position, visibility of targets, temperature and radiation. Nothing is downloaded."""
