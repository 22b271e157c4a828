"""The safety kernel: all that decides what reaches the valves. Pure, but for `bus_process`."""
