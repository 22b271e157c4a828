"""The twin: behaves on the bus as gateway and machine do, with a simulated machine behind it."""
