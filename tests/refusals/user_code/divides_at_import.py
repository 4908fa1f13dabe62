Mine = 1 / 0
