"""Grey-box fit of INTECO's TRAS to the first part of a closed-loop record, judged on the rest."""
