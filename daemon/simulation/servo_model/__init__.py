"""Emulated Dynamixel servos: control table, what its registers do, packets on their bus."""
