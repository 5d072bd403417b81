"""Low-level messages of the type unitree_go (Go2, B2, H1): byte layouts, and values in a robot's own order.

Each robot gives its motor numbers; other motor slots have no motor. Payloads are whole CDR messages with
their 4-byte header, as DDS and Zenoh carry them.

A hazard of this wire: LowCmd has 812 bytes and LowState 1180, both as CDR with header and as the C struct
over which the vendor computes the checksum. The two layouts differ. A C struct in place of CDR is refused,
because the CDR header is missing.
"""
