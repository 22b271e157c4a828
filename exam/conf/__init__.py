"""Configuration of the exam: what an extension registers by the entry point `brokk_rl.conf`."""
