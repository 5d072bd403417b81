/* A program as an owner of a robot of ros2_control would write it in C, on Cyclone DDS 0.10.2, without ROS.
 *
 *   ros2_peer DOMAIN STATES COMMANDS MESSAGES TARGET...
 *
 * Reads sensor_msgs/JointState from the topic STATES, and writes MESSAGES times at 50 Hz a std_msgs/Float64MultiArray of
 * the TARGETs to COMMANDS. Topics are named as on the wire, such as rt/joint_states. It talks on loopback. It prints
 * "commanding" after its first command that has a reader, and ends with one line of JSON: the joints' names and
 * positions of the last state, and how many states came. SIGTERM ends it early.
 */
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "dds/dds.h"
#include "dds/version.h"
#include "ros2_messages.h"

typedef sensor_msgs_msg_dds__JointState_ JointState;
typedef std_msgs_msg_dds__Float64MultiArray_ Targets;

enum { BATCH = 16, JOINTS = 32, MEET_CYCLES = 500 };

static const char CONFIGURATION[] =
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address=\"127.0.0.1\" multicast=\"true\"/></Interfaces>"
    "</General><Tracing><Verbosity>warning</Verbosity><OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>";

static volatile sig_atomic_t stopped = 0;

static void on_signal(int number) {
  (void)number;
  stopped = 1;
}

static dds_entity_t check(dds_entity_t code, const char *what) {
  if (code < 0) {
    fprintf(stderr, "ros2_peer: %s: %s\n", what, dds_strretcode(-code));
    exit(1);
  }
  return code;
}

/* Takes all states and returns how many came; if `last`, prints the newest one, if there is one, as the JSON of the end.
 */
static unsigned long take_states(dds_entity_t in, bool last, unsigned long before) {
  void *samples[BATCH] = {NULL};
  dds_sample_info_t infos[BATCH];
  const JointState *newest = NULL;
  unsigned long came = 0;
  int taken = check(dds_take(in, samples, infos, BATCH, BATCH), "take the states");
  for (int i = 0; i < taken; i++) {
    if (!infos[i].valid_data) continue;
    newest = samples[i];
    came++;
  }
  if (last && newest && newest->position._length == newest->name._length) {
    printf("{\"version\": \"%s\", \"received\": %lu, \"position\": {", DDS_VERSION, before + came);
    for (uint32_t i = 0; i < newest->name._length; i++)
      printf("%s\"%s\": %.6f", i ? ", " : "", newest->name._buffer[i], newest->position._buffer[i]);
    printf("}}\n");
  }
  if (taken > 0) check(dds_return_loan(in, samples, taken), "return loan");
  return came;
}

static bool has_reader(dds_entity_t out) {
  dds_publication_matched_status_t status;
  check(dds_get_publication_matched_status(out, &status), "matched readers");
  return status.current_count > 0;
}

int main(int argc, char **argv) {
  if (argc < 6 || argc - 5 > JOINTS) {
    fprintf(stderr, "usage: ros2_peer DOMAIN STATES COMMANDS MESSAGES TARGET... (at most %d)\n", JOINTS);
    return 64;
  }
  dds_domainid_t domain = (dds_domainid_t)strtoul(argv[1], NULL, 10);
  unsigned long messages = strtoul(argv[4], NULL, 10), received = 0;
  double values[JOINTS];
  for (int i = 5; i < argc; i++) values[i - 5] = strtod(argv[i], NULL);
  Targets targets = {.data = {._length = (uint32_t)(argc - 5), ._maximum = JOINTS, ._buffer = values}};
  signal(SIGTERM, on_signal);
  signal(SIGINT, on_signal);

  check(dds_create_domain(domain, CONFIGURATION), "create domain");
  dds_entity_t participant = check(dds_create_participant(domain, NULL, NULL), "create participant");
  dds_entity_t states = check(
      dds_create_topic(participant, &sensor_msgs_msg_dds__JointState__desc, argv[2], NULL, NULL), argv[2]);
  dds_entity_t commands = check(
      dds_create_topic(participant, &std_msgs_msg_dds__Float64MultiArray__desc, argv[3], NULL, NULL), argv[3]);
  dds_entity_t in = check(dds_create_reader(participant, states, NULL, NULL), "create reader");
  dds_entity_t out = check(dds_create_writer(participant, commands, NULL, NULL), "create writer");

  for (int cycle = 0; !has_reader(out) && !stopped; cycle++) {
    if (cycle >= MEET_CYCLES) {
      fprintf(stderr, "ros2_peer: nobody reads %s within 10 s\n", argv[3]);
      return 2;
    }
    dds_sleepfor(DDS_MSECS(20));
  }
  for (unsigned long sent = 0; sent < messages && !stopped; sent++) {
    check(dds_write(out, &targets), "write a command");
    if (sent == 0) {
      printf("commanding\n");
      fflush(stdout);
    }
    dds_sleepfor(DDS_MSECS(20));
    received += take_states(in, false, received);
  }
  for (int cycle = 0; cycle < MEET_CYCLES && take_states(in, true, received) == 0; cycle++) dds_sleepfor(DDS_MSECS(20));
  fflush(stdout);
  check(dds_delete(participant), "delete participant");
  return 0;
}
