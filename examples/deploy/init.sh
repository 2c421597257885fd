#!/bin/bash
# PID 1 of a container: starts mavbridge, passes signals on, and ends only when the gate has ended, too.

# Whether a process is left whose parent is this one: the gate of a dead mavbridge becomes one.
has_children() {
  local file key value
  for file in /proc/[0-9]*/status; do
    while read -r key value; do
      [[ $key == PPid: ]] || continue
      [[ $value == "$$" ]] && return 0
      break
    done 2> /dev/null < "$file"
  done
  return 1
}

mavbridge "$@" &
flight=$!
trap 'kill -TERM "$flight" 2> /dev/null' TERM INT

# A signal interrupts the wait while the process is still there.
while kill -0 "$flight" 2> /dev/null; do
  wait "$flight"
  status=$?
done
while has_children; do
  sleep 0.2
done
exit "${status:-1}"
