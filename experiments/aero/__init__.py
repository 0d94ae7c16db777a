"""The Quanser Aero's normal state: fitted to one closed-loop recording, judged on another."""
