"""Would the Mauve satellite see this stellar flare, and how sure can one be?"""

__version__ = "0.1.0"
