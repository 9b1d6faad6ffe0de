"""What equations are written with: the decorator `formula`, elementary functions and checks."""

__all__ = ['checks', 'formula']
