# Builds the controller and its example. The flags that count for speed and exactness:
#   -O3                  vectorises the recursion; -O2 is close to it
#   -std=c99             GCC then keeps operations as they are written (no fused multiply-add);
#                        clang needs -ffp-contract=off for that, where the last digits count
#   NATIVE=-march=native uses all of this processor; the result runs on no older one
# Never -ffast-math: it takes the checks for NaN away.
CC ?= cc
NATIVE ?=
CFLAGS ?= -std=c99 -O3 -Wall -Wextra -pedantic

all: mpc_example

mpc.o: mpc.c mpc.h
	$(CC) $(CFLAGS) $(NATIVE) -c mpc.c

mpc_example: mpc_example.c mpc.o mpc.h
	$(CC) $(CFLAGS) $(NATIVE) -o $@ mpc_example.c mpc.o -lm

# agreement with the recorded commands, and times
check: mpc_example
	./mpc_example example.csv 5

size: mpc.o
	size mpc.o

clean:
	rm -f mpc.o mpc_example

.PHONY: all check size clean
