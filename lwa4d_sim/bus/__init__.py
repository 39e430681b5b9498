"""The CAN bus: frames and the wire in simulated time, the CANopen drives on it and the master that leads them."""
