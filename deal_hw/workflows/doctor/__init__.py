"""The checks of `deal-hw doctor`."""
