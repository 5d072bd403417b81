"""The Unitree Go2: facts and light models of the robot on the floor and with its base on a stand."""
