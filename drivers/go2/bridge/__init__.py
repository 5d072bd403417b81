"""The bridge on the robot's own computer: DDS to the robot, Zenoh to the network, a check of each command."""
