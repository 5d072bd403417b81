"""Makes a robot passive, for ``deal-hw stop``: from here at first, only the standard library is loaded."""
