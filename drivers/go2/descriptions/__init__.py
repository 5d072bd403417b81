"""Facts about the Go2 on the floor and with its base on a stand, and the geometry of its legs."""
