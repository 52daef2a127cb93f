"""What tests have in common: meshes and problems, exact references, samples of files, troubles. No test is in here."""
