"""What runs on the robot's own computer: DDS on its side, Zenoh on the network's, and a judge between."""
