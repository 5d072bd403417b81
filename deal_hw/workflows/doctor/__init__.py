"""What `deal-hw doctor` looks at."""
