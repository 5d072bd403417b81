"""Messages of the Go2's wire: topics, byte layouts, and values in SI units and model order.

Only the wire knows the order FR, FL, RR, RL of legs and joints; names join it to the model's. Payloads are
whole CDR messages with their 4-byte header, as DDS and Zenoh carry them.

A hazard of this wire: LowCmd has 812 bytes and LowState 1180, as CDR with header and also as the C struct of
the vendor's checksum. The two layouts differ. A C struct given as CDR is refused by its missing header.
"""
