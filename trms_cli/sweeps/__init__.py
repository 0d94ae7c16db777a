"""Sweeps: which runs are to be made (samplers), where (launchers), and that none is lost (driver)."""
