import time

Mine = time.sleep(60)
