"""What the article prints (Electronics 2025, 14(13), 2678), with the table each number stands in."""

# Tables 4 and 5: largest absolute pressure errors over the 20 s lift, MPa: nominal and perturbed load
NOMINAL_ERROR_MPA = {"p1": 0.1001, "p2": 0.0093}
PERTURBED_ERROR_MPA = {"p1": 0.0402, "p2": 0.0099}

# Table 3
NORMALISED_ERROR = 2.4e-9
TRAINING_ITERATIONS = 1537
TRAINING_S = 20 * 3600.0 + 11 * 60.0

# Table 6: mean time of one step, not compiled, another machine (AMD 4800H)
SURROGATE_STEP_MS = 0.2011
FIRST_PRINCIPLE_STEP_MS = 4.3103
SPEED_RATIO = FIRST_PRINCIPLE_STEP_MS / SURROGATE_STEP_MS

# Table 7: sizes of two processes
FIRST_PRINCIPLE_MB = 334.35
SURROGATE_MB = 206.09

# Section 4.2.1: what it counts; a 5-25-10-20-2 network has 672
PARAMETERS_PRINTED = 333
PARAMETERS = 672
