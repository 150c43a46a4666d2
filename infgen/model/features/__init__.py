"""What parts of the network are told beside what attention sees."""
