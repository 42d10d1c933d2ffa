"""What every room stands on: files, threads, processes, machine, typed values, text. It imports nothing of hqgs."""
