"""Messages of the Go2's wire: unitree_go's low-level ones for 12 motors, and those of sport mode.

Only these modules use the wire's leg order FR, FL, RR, RL; they convert it to the model's order by name. The
bytes are those of :mod:`deal_hw.drivers.unitree.go_messages`.
"""
