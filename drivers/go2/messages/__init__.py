"""Messages of the Go2's wire: byte layouts, and values in SI units and model order.

Only these modules use the wire's leg order FR, FL, RR, RL; they convert it to the model's order by name.
Payloads are whole CDR messages with their 4-byte header, as DDS and Zenoh carry them.

A hazard of this wire: LowCmd has 812 bytes and LowState 1180, both as CDR with header and as the C struct
over which the vendor computes the checksum. The two layouts differ. A C struct in place of CDR is refused,
because the CDR header is missing.
"""
