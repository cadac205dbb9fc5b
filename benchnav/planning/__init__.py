"""Problems, planners and the simulation they are tested in (paper, III-C and IV-A)."""
