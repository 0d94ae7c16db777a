"""Sweeps: which runs are to be made (samplers), where (launchers), and none is lost (driver)."""
